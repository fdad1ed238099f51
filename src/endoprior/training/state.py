"""What changes while Gaussians are trained, and a training frame that was rendered from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor

from ..core.types import RenderOutput, Splats
from ..model.gaussians import Gaussians, Offsets
from ..model.motion import Field
from .density_stats import DensityStats
from .frames import TrainingFrame
from .optimizer import Optimizer
from .tracks import StartTracks
from .trainer import Stage


@dataclass
class GaussiansState:
    """All that changes while training; a checkpoint holds exactly this."""

    stage: Stage
    iteration: int  # iterations of this stage already done
    gaussians: Gaussians
    field: Field | None
    optimizer: Optimizer
    stats: DensityStats
    tracks: StartTracks | None  # where motion started from optical flow and is held to it
    left_out: Tensor | None  # (F, VISITS) share of the view that showed a missed tool in the last visits of each frame

    def arrays(self) -> dict[str, Tensor]:
        """Every tensor by the name that it has in a checkpoint."""
        parts = {
            "gaussians": {name: value.detach() for name, value in self.gaussians.tensors.items()},
            "stats": self.stats.tensors(),
            "optimizer": self.optimizer.state_arrays(),
            "tracks": self.tracks.tensors() if self.tracks else {},
            "field": self.field.state_arrays() if self.field else {},
        }
        arrays = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        return arrays if self.left_out is None else arrays | {"left_out": self.left_out}


class Before(NamedTuple):
    """The training frame just before, with which the temporal term compares."""

    frame: TrainingFrame
    tissue_mask_now: Tensor  # (H, W) bool of the rendered frame: True at a tool that the masks miss, too
    means: Tensor | None  # (N, 3) centers at the frame before, mm, where they are known already


@dataclass(frozen=True)
class ForwardPass:
    """A training frame that was rendered, and what it was rendered from: what the loss of a method sees."""

    stage: Stage
    iteration: int  # 1-based, within the stage
    position: int  # place of the frame among the training frames
    frame: TrainingFrame  # what is compared: without the pixels that show a tool in spite of the mask
    gaussians: Gaussians
    field: Field | None
    offsets: Offsets | None  # what moved them; None in the coarse stage
    splats: Splats  # the Gaussians as they were rendered
    out: RenderOutput
    render: Callable[[Splats], RenderOutput]  # other Gaussians from the same camera
    context: Any  # what the method's `context` made of all training frames
    before: Before | None = None  # the frame before, where the temporal term takes part
    is_right: bool = False  # of the right eye: only its image and depth are compared
    left_out: float | None = None  # share of the view that shows a missed tool; None where that was not asked
