"""What a training run is, whatever the method: it starts or is restored, iterates in two stages, and gives a scene."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from .. import render
from ..core.checks import InputError
from ..core.config import Config
from ..core.types import Camera
from ..data import FrameSequence
from ..model.rendered_scene import RenderedScene
from ..model.scene_file import check_cameras
from ..system.arrays_file import ArraySpec

DEFAULT_FRAMES_PER_SECOND = 25.0  # playing speed of a sequence that does not state its own


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
    """1-based, within the stage."""
    losses: Mapping[str, Tensor]
    """Weighted terms of the loss that took part, () each."""
    num_gaussians: int
    """After the iteration; 0 for a radiance field."""
    seconds: float
    event: Mapping[str, int] | None = None
    """What density control did after the iteration, if it did anything: `Plan.counts`."""
    missed_tool_frames: tuple[int, ...] | None = None
    """After the last iteration: frames of the sequence whose masks likely miss a tool; None if masks are trusted."""

    @cached_property
    def terms(self) -> dict[str, float]:
        """`losses` as numbers; the host waits for the device."""
        return {name: float(value) for name, value in self.losses.items()}


class State(Protocol):
    """What changes while training; a checkpoint holds exactly this."""

    stage: Stage
    iteration: int  # iterations of this stage already done

    def arrays(self) -> dict[str, Tensor]:
        """Every tensor by the name that it has in a checkpoint."""
        ...


class Trainer(ABC):
    """One training run: `start` or `restore`, then `run`; `scene` is its result so far."""

    sequence: FrameSequence
    cfg: Config  # fitted to the length of the sequence
    device: torch.device
    state: State  # from `start` or `restore` on

    @abstractmethod
    def start(self) -> None:
        """Build the state before the first iteration."""

    @abstractmethod
    def restore(self, stage: Stage, iteration: int, arrays: Mapping[str, Tensor]) -> None:
        """Continue from a state that `State.arrays` gave and that `schema` describes."""

    @abstractmethod
    def schema(self) -> dict[str, ArraySpec]:
        """Names, types and shapes of the arrays of its state; `F` training frames."""

    @abstractmethod
    def step(self) -> StepReport:
        """One iteration.

        Raises:
            Diverged: training cannot go on. Nothing infinite has reached the state, and `state.iteration` is the last
                good one.
        """

    @abstractmethod
    def scene(self) -> RenderedScene:
        """The scene as it is now, on the CPU."""

    @abstractmethod
    def synchronize(self) -> None:
        """Wait for a device and check what it did, so that the state is known to be good; on the CPU it always is.

        Raises:
            Diverged: as `step`.
        """

    def notes(self) -> list[str]:
        """Lines for the user, before the training, about what the frames ask for."""
        return []

    @property
    def finished(self) -> bool:
        """Whether all iterations are done."""
        done, total = self.progress()
        return done >= total

    def progress(self) -> tuple[int, int]:
        """Iterations done and in all, over both stages."""
        coarse, fine = stage_length(self.cfg, Stage.COARSE), stage_length(self.cfg, Stage.FINE)
        before = coarse if self.state.stage is Stage.FINE else 0
        return before + self.state.iteration, coarse + fine

    def run(self, observers: list[Observer]) -> None:
        """Iterate to the end; every observer is called after each iteration, in order.

        Raises:
            Diverged: as `step`.
        """
        while not self.finished:
            report = self.step()
            for observe in observers:
                observe(report, self)


Observer = Callable[[StepReport, Trainer], None]  # called after each iteration: progress, log, checkpoints, viewer


def cameras_of(sequence: FrameSequence) -> tuple[Camera, ...]:
    """The camera of each frame; InputError if a scene with them could not be loaded again."""
    cameras = tuple(sequence.camera(i) for i in range(len(sequence)))
    try:
        check_cameras(cameras)
    except InputError as error:
        raise InputError(f"{sequence.path}: {error} Check the calibration and the unit of the poses.") from None
    return cameras


def device_for(backend: render.Backend) -> torch.device:
    """The device that a rendering backend computes on.

    Raises:
        InputError: it is a GPU, and torch finds none.
    """
    if backend not in render.ON_GPU:
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise InputError(
            f"render.backend {backend}: expected a GPU that torch can use; found none. Leave it out for the CPU; "
            "`endoprior doctor` tells what is missing."
        )
    return torch.device("cuda")
