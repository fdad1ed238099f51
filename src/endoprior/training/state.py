"""What changes while training, and what one iteration reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import torch
from torch import Tensor

from ..model.deformation import HexPlaneField
from ..model.gaussians import Gaussians
from .density import DensityStats
from .optimizer import Optimizer


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

    def tensors(self) -> list[Tensor]:
        """Every tensor that an iteration may change in place."""
        found = [*self.gaussians.tensors.values(), *self.stats.tensors().values(), *self.optimizer.tensors()]
        if self.field is not None:
            grid = self.field.grid
            found += [grid.values, grid.grads, grid.marks, self.field.box, *self.field.heads.parameters.values()]
        return [tensor.detach() for tensor in found]


class Losses:
    """Weighted terms of Eq. (12) that took part in one iteration; asking for `numbers` waits for a device."""

    def __init__(self, names: tuple[str, ...], values: Tensor) -> None:
        """Args: values: (len(names),)."""
        self.names, self.values = names, values

    @staticmethod
    def of(terms: Mapping[str, Tensor]) -> Losses:
        """Of terms () each, by name, on one device."""
        return Losses(tuple(terms), torch.stack([value.detach() for value in terms.values()]))

    @cached_property
    def numbers(self) -> dict[str, float]:
        """The terms by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))


@dataclass(frozen=True)
class StepReport:
    """What one iteration did."""

    stage: Stage
    iteration: int
    losses: Losses
    num_gaussians: int
    seconds: float
    """That it took; on a device a mean over some before it."""

    @property
    def terms(self) -> dict[str, float]:
        """Weighted terms of Eq. (12) that took part."""
        return self.losses.numbers
