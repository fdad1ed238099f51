"""What the steps of one job hand on to later ones, as long as the process lives: nothing is computed twice.

A step that finds nothing here, because the job was interrupted, computes it itself, with the same result.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ..data import FrameSequence
from ..evaluation.context import RenderedFrames
from ..footage.known_facts import KnownFacts


@dataclass
class HandedOn:
    """Empty at first."""

    facts: KnownFacts = field(default_factory=KnownFacts)  # of the prepared frames; from `prepare` to `check`
    sequence: FrameSequence | None = None
    """As the training reads it, with the frames that it holds decoded; from `check` to `train`."""
    rendered: RenderedFrames | None = None  # the frames as the scene renders them; from `score` to `video`
