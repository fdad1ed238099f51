"""Live view of a training: renders the scene between two iterations, in the training thread.

The training result does not change: rendering computes no gradient, uses no random generator and writes no training
state. Its share of the time is bounded.
"""

from __future__ import annotations

import time as clock
from typing import TYPE_CHECKING

from ..model.scene import Scene
from ..system.console import say
from .server import Viewer
from .viewable_scene import ViewableScene

if TYPE_CHECKING:
    from ..training.trainer import StepReport, Trainer

REFRESH_SECONDS = 2.0
"""Least time between two displayed states."""
MAX_TIME_SHARE = 0.2
"""Largest share of the time for refreshing; slow images are refreshed less often. User input is handled at once."""


class LiveView:
    """An `on_step` callback of `runs.train.train` that updates a viewer at `host` and `port`."""

    def __init__(self, host: str, port: int) -> None:
        self.host, self.port = host, port
        self.viewer: Viewer | None = None  # it starts after the first iteration
        self._due = 0.0

    def __call__(self, report: StepReport, trainer: Trainer) -> None:
        """After an iteration: handle user input, and from time to time show the new state."""
        if self.viewer is None:
            self.viewer = Viewer(_subject(report, trainer), host=self.host, port=self.port)
            say(f"view: {self.viewer.url}")
        began = clock.monotonic()
        refreshes = began >= self._due and self.viewer.watched
        if refreshes:
            self.viewer.show(_subject(report, trainer))
        self.viewer.work()
        if refreshes:
            now = clock.monotonic()
            self._due = now + max(REFRESH_SECONDS, (now - began) / MAX_TIME_SHARE)

    def close(self) -> None:
        if self.viewer is not None:
            self.viewer.close()


def _subject(report: StepReport, trainer: Trainer) -> ViewableScene:
    title = f"{report.stage.name.lower()}, iteration {report.iteration}, {report.num_gaussians} Gaussians"
    scene = trainer.scene()
    assert isinstance(scene, Scene), "`train --view` takes methods of Gaussians only"
    return ViewableScene(scene, title, trainer.sequence)
