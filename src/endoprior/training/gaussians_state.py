"""What changes while Gaussians are trained."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ..model.field import Field
from ..model.gaussians import Gaussians
from .density import DensityStats
from .optimizer import Optimizer
from .stage import Stage
from .track_loss import StartTracks


@dataclass
class GaussiansState:
    """All that changes while training; a checkpoint holds exactly this."""

    stage: Stage
    iteration: int
    """Iterations of this stage already done."""
    gaussians: Gaussians
    field: Field | None
    optimizer: Optimizer
    stats: DensityStats
    tracks: StartTracks | None = None
    """Where motion started from optical flow and is held to it."""
    left_out: Tensor | None = None
    """(F, VISITS) share of the view that was left out as a missed tool in the last visits of each training frame."""

    def arrays(self) -> dict[str, Tensor]:
        """Every tensor by the name that it has in a checkpoint."""
        arrays = {f"gaussians.{name}": value.detach() for name, value in self.gaussians.tensors.items()}
        arrays |= {f"stats.{name}": value for name, value in self.stats.tensors().items()}
        arrays |= {f"optimizer.{name}": value for name, value in self.optimizer.state_arrays().items()}
        if self.tracks is not None:
            arrays |= {f"tracks.{name}": value for name, value in self.tracks.tensors().items()}
        if self.left_out is not None:
            arrays["left_out"] = self.left_out
        if self.field is not None:
            arrays |= {f"field.{name}": value for name, value in self.field.state_arrays().items()}
        return arrays
