"""What changes while training, and what one iteration reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

from torch import Tensor

from ..model.deformation import HexPlaneField
from ..model.gaussians import Gaussians
from .density import DensityStats
from .divergence import Divergence
from .optimizer import Optimizer
from .pose_refinement import PoseState
from .track_loss import StartTracks


class Stage(IntEnum):
    """The two stages, in order."""

    COARSE = 0
    FINE = 1


@dataclass
class TrainState:
    """All that changes while training; a checkpoint holds exactly this."""

    stage: Stage
    iteration: int
    """Iterations of this stage already done."""
    gaussians: Gaussians
    field: HexPlaneField | None
    optimizer: Optimizer
    stats: DensityStats
    tracks: StartTracks | None = None
    """Where motion started from optical flow and is held to it."""
    poses: PoseState | None = None
    """Corrections of the camera poses; None: they stay as given."""

    depth_fit: Tensor | None = None
    """(F, 2) scale and shift of each training frame's inverse depth, where depth is relative."""

    def arrays(self) -> dict[str, Tensor]:
        """Every tensor by the name that it has in a checkpoint."""
        arrays = {f"gaussians.{name}": value.detach() for name, value in self.gaussians.tensors.items()}
        arrays |= {f"stats.{name}": value for name, value in self.stats.tensors().items()}
        arrays |= {f"optimizer.{name}": value for name, value in self.optimizer.state_arrays().items()}
        if self.tracks is not None:
            arrays |= {f"tracks.{name}": value for name, value in self.tracks.tensors().items()}
        if self.poses is not None:
            arrays |= {f"poses.{name}": value for name, value in self.poses.tensors().items()}
        if self.depth_fit is not None:
            arrays["depth_fit"] = self.depth_fit
        if self.field is not None:
            arrays |= {f"field.{name}": value for name, value in self.field.state_arrays().items()}
        return arrays


@dataclass(frozen=True)
class StepReport:
    """What one iteration did."""

    stage: Stage
    iteration: int
    losses: Mapping[str, Tensor]
    """Weighted terms of Eq. (12) that took part, () each."""
    num_gaussians: int
    seconds: float
    divergence: Divergence | None = None
    """Why training cannot continue, if it cannot; on a device it may concern an earlier iteration."""

    @cached_property
    def terms(self) -> dict[str, float]:
        """`losses` as numbers; the host waits for the device."""
        return {name: float(value) for name, value in self.losses.items()}
