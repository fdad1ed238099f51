"""The stages of a training, and what one iteration reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

from torch import Tensor

from ..core.config import Config
from .divergence import Divergence


class Stage(IntEnum):
    """The two stages, in order."""

    COARSE = 0
    FINE = 1


def stage_length(cfg: Config, stage: Stage) -> int:
    """Iterations of a stage."""
    return cfg.schedule.coarse_iterations if stage is Stage.COARSE else cfg.schedule.fine_iterations


@dataclass(frozen=True)
class StepReport:
    """What one iteration did."""

    stage: Stage
    iteration: int
    losses: Mapping[str, Tensor]
    """Weighted terms of the loss that took part, () each."""
    num_gaussians: int
    """After the iteration; 0 for a radiance field."""
    seconds: float
    event: Mapping[str, int] | None = None
    """What density control did after the iteration, if it did anything: `Plan.counts`."""
    divergence: Divergence | None = None
    """Why training cannot continue, if it cannot; on a device it may concern an earlier iteration."""

    missed_tool_frames: tuple[int, ...] | None = None
    """After the last iteration: frames of the sequence whose masks likely miss a tool; None if masks are trusted."""

    @cached_property
    def terms(self) -> dict[str, float]:
        """`losses` as numbers; the host waits for the device."""
        return {name: float(value) for name, value in self.losses.items()}
