"""Which frames saw the tissue. All else that a scene shows is carried from another time, or a guess."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.types import Frame
from .scene import Scene, Window
from .single_scene import SingleScene
from .surface import project_visible, render_surface

FramesOf = Callable[[Window], Iterable[Frame]]
"""The frames that a window was trained on; their times count from its start (`FrameSequence.part`)."""


@dataclass(frozen=True)
class WindowSupport:
    """Which of its `F` frames show each of the `N` Gaussians of a window: on tissue, in the image, and not hidden."""

    seen: NDArray[np.bool_]
    """(N, F)."""
    positions: NDArray[np.float64]
    """(F,) of these frames, counted from the start of the window."""

    @property
    def num_frames(self) -> NDArray[np.int64]:
        """(N,) frames that show it; 0: a guess."""
        return self.seen.sum(1)

    def gap(self, position: float) -> NDArray[np.float64]:
        """(N,) frames from `position` to the nearest one that shows it; infinite for a guess."""
        distance = np.where(self.seen, np.abs(self.positions - position), np.inf)
        return distance.min(1, initial=np.inf)


class Support:
    """The support of the Gaussians that a scene shows at each time, in the order of `Scene.at`."""

    def __init__(self, scene: Scene, frames_of: FramesOf) -> None:
        """Args: frames_of: what each window was trained on; asked when it is shown first."""
        self._scene, self._frames_of = scene, frames_of
        self._windows: dict[int, WindowSupport] = {}

    def _of(self, window: Window) -> WindowSupport:
        if window.start not in self._windows:
            self._windows[window.start] = window_support(window.scene, self._frames_of(window))
        return self._windows[window.start]

    def share(self, time: float) -> NDArray[np.float64]:
        """(N,) share of the training frames of its window that show each Gaussian."""
        parts = [self._of(shown.window) for shown in self._scene.shown_at(time)]
        return np.concatenate([part.num_frames / max(len(part.positions), 1) for part in parts])

    def num_frames(self, time: float) -> NDArray[np.int64]:
        """(N,) training frames that show each Gaussian; 0: a guess."""
        return np.concatenate([self._of(shown.window).num_frames for shown in self._scene.shown_at(time)])

    def gap(self, time: float) -> NDArray[np.float64]:
        """(N,) seconds from `time` to the nearest frame that shows each Gaussian; infinite for a guess."""
        shown = self._scene.shown_at(time)
        gaps = [self._of(s.window).gap(s.time * (s.window.stop - s.window.start)) for s in shown]
        return np.concatenate(gaps) / self._scene.frames_per_second


def window_support(scene: SingleScene, frames: Iterable[Frame]) -> WindowSupport:
    """The support of one window in the `frames` that it was trained on."""
    seen, positions = [], []
    for frame in frames:
        means = scene.at(frame.time).means.cpu().numpy()
        surface = render_surface(scene, frame.time, frame.camera)
        seen.append(project_visible(means, surface, frame.tissue_mask)[1])
        positions.append(frame.time * len(scene.cameras))
    none = np.zeros((len(scene), 0), bool)
    return WindowSupport(np.stack(seen, 1) if seen else none, np.array(positions, np.float64))
