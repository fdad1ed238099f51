"""Watching a scene while it trains: between two iterations, in the thread that trains, parameters are read and drawn.

Nothing of the training is changed: drawing takes no gradient, touches no random generator, and everything it keeps is
its own. It costs time, which is bounded.
"""

from __future__ import annotations

import time as clock
from typing import TYPE_CHECKING

from .scene_subject import SceneSubject
from .server import Viewer

if TYPE_CHECKING:
    from ..training.state import StepReport
    from ..training.trainer import Trainer

REFRESH_SECONDS = 2.0
"""Training goes on at least this long between two states that are shown."""
LARGEST_SHARE = 0.2
"""Of the time, that refreshing may take: a slow picture comes less often. What a person asks for comes at once."""


class LiveView:
    """An `on_step` of `train.train` that keeps a viewer at the state of the training."""

    def __init__(self, host: str, port: int) -> None:
        """Nothing listens until the first iteration is done.

        Args:
            host, port: see `Viewer`.
        """
        self.host, self.port = host, port
        self.viewer: Viewer | None = None
        self._due = 0.0

    def __call__(self, report: StepReport, trainer: Trainer) -> None:
        """After an iteration: answer the browsers, and every now and then show the new state."""
        if self.viewer is None:
            self.viewer = Viewer(self._subject(report, trainer), host=self.host, port=self.port)
            print(f"view: {self.viewer.url}", flush=True)
        began = clock.monotonic()
        if began >= self._due and self.viewer.watched:
            self.viewer.show(self._subject(report, trainer))
            self.viewer.work()
            took = clock.monotonic() - began
            self._due = clock.monotonic() + max(REFRESH_SECONDS, took / LARGEST_SHARE)
        else:
            self.viewer.work()

    def close(self) -> None:
        """Stop listening."""
        if self.viewer is not None:
            self.viewer.close()

    @staticmethod
    def _subject(report: StepReport, trainer: Trainer) -> SceneSubject:
        title = f"{report.stage.name.lower()}, iteration {report.iteration}, {report.num_gaussians} Gaussians"
        return SceneSubject(trainer.scene(), title, trainer.sequence)
