"""What changes while training, and what one iteration reports."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from .density import DensityStats
from .model.deformation import HexPlaneField
from .model.gaussians import Gaussians
from .optim import Optimizer


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


@dataclass(frozen=True)
class StepReport:
    """What one iteration did."""

    stage: Stage
    iteration: int
    terms: dict[str, float]
    """Weighted terms of Eq. (12) that took part."""
    num_gaussians: int
    seconds: float
