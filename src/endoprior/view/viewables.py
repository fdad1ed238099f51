"""What the viewer shows: a trained scene or a raw sequence."""

from __future__ import annotations

from .viewable_scene import ViewableScene
from .viewable_sequence import ViewableSequence

Viewable = ViewableScene | ViewableSequence
