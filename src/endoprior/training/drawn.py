"""What a method sees of one iteration when it computes its loss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..core.types import RenderOutput, Splats
from ..model.deformation import Offsets
from ..model.field import Field
from ..model.gaussians import Gaussians
from .frames import TrainingFrame
from .stage import Stage


@dataclass(frozen=True)
class Drawn:
    """A training frame that was rendered, and what it was rendered from."""

    stage: Stage
    iteration: int
    """1-based, within the stage."""
    position: int
    """Place of the frame among the training frames."""
    frame: TrainingFrame
    """What is compared."""
    gaussians: Gaussians
    field: Field | None
    offsets: Offsets | None
    """What moved them; None in the coarse stage."""
    splats: Splats
    """The Gaussians as they were drawn."""
    out: RenderOutput
    draw: Callable[[Splats], RenderOutput]
    """Draws other Gaussians from the same camera."""
    context: Any
    """What the method's `context` made of all training frames."""
