"""A trained scene: the tissue at any time, from any viewpoint.

A scene consists of windows: spans of frames with Gaussians of their own. Most scenes have one (`SingleScene`); a long
sequence of a moving camera has several (`WindowedScene`), and where two overlap, one fades into the other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .. import render
from ..core.checks import input_error
from ..core.config import Config
from ..core.types import Camera, RenderedView, Splats
from .method import Method, method_of
from .photometric import behind_smoke, between
from .playback import Background, faded, joined, rendered, rendered_many

if TYPE_CHECKING:
    from .single_scene import SingleScene


@dataclass(frozen=True)
class Window:
    """A span of frames with Gaussians of its own."""

    start: int  # its first frame, counted over the sequence
    stop: int  # the frame after its last one
    load: Callable[[], SingleScene]  # gives its scene, which may be read from a file then

    @property
    def scene(self) -> SingleScene:
        """Its Gaussians; times of this scene count from `start`."""
        return self.load()


@dataclass(frozen=True)
class Shown:
    """A window that a scene shows at some time."""

    window: Window
    time: float  # that time in the window's own scene, in [0, 1]
    weight: float  # in (0, 1]: 1 unless two windows overlap there; they add up to 1


class RenderedScene(ABC):
    """What renders the tissue at any time from any viewpoint. Frame i of T was taken at time i / T."""

    config: Config
    cameras: tuple[Camera, ...]
    """Camera of each frame of the sequence."""
    frames_per_second: float
    lengths_are_relative: bool
    """Whether the scale of the sequence's depth was assumed: lengths are then not in mm."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device that holds the scene and renders it."""

    @property
    @abstractmethod
    def backend(self) -> str:
        """What renders it, in words."""

    @abstractmethod
    def to(
        self, device: torch.device | str, *, backend: render.Backend | None = None, fp16_planes: bool = False
    ) -> RenderedScene:
        """This scene on a device; itself if it is there.

        Args:
            backend: renders Gaussians there; None: the one they were trained with, or gsplat on a GPU.
            fp16_planes: HexPlane in half precision, half the memory and faster: for rendering, cannot be saved.
        """

    @abstractmethod
    def save(self, path: str | Path) -> None:
        """Write the scene as safetensors, completely or not at all.

        Raises:
            ValueError: its planes are in half precision.
        """

    @abstractmethod
    def render(self, time: float, camera: Camera | None = None) -> RenderedView:
        """Render the scene at `time` in [0, 1], from `camera` or else the camera of the frame nearest in time.

        Returns:
            color (H, W, 3) in [0, 1], depth (H, W) mm as the sum of weight * z, expected_depth (H, W) mm, which is
            divided by alpha, alpha (H, W) in [0, 1], and unclamped_color (H, W, 3).
        Raises:
            ValueError: time is not in [0, 1].
        """

    def __bool__(self) -> bool:
        """A scene is one without any Gaussians too."""
        return True

    def __len__(self) -> int:
        """Number of Gaussians in all windows.

        Raises:
            InputError: it is a radiance field, which has none.
        """
        return len(with_gaussians(self))

    def at(self, time: float, camera: Camera | None = None) -> Splats:
        """The Gaussians at `time`, activated; see `Scene.at`.

        Raises:
            InputError: it is a radiance field, which has none.
        """
        return with_gaussians(self).at(time, camera)

    def render_many(self, times: list[float], cameras: list[Camera]) -> list[RenderedView]:
        """`render` at several times, one camera each."""
        return [self.render(time, camera) for time, camera in zip(times, cameras, strict=True)]

    def smoke_at(self, _time: float) -> Tensor | None:
        """(I, J, 2) gain and veil of the smoke that the endoscope sees at a time: see `photometric`; None: none."""
        return None

    def filmed(self, time: float, camera: Camera | None = None) -> RenderedView:
        """`render` with the smoke of that time, as frames show it."""
        return behind_smoke(self.render(time, camera), self.smoke_at(time))

    def camera_at(self, time: float) -> Camera:
        """Camera of the frame nearest in time."""
        return self.cameras[min(round(time * len(self.cameras)), len(self.cameras) - 1)]


class Scene(RenderedScene):
    """A scene of Gaussians."""

    rendered_by: render.Backend | None
    """Rendering backend; None: the one it was trained with, where it can be used."""

    @property
    @abstractmethod
    def windows(self) -> Sequence[Window]:
        """Its windows, in order; a window overlaps the next one only."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of Gaussians in all windows."""

    @abstractmethod
    def changed(self, change: Callable[[SingleScene, Window], SingleScene]) -> Scene:
        """A scene whose windows are what `change` makes of the scene of each; possibly only when they are shown."""

    def shown_at(self, time: float) -> list[Shown]:
        """The windows that the scene shows at `time`: one, or the two that overlap there.

        Raises:
            ValueError: time is not in [0, 1].
        """
        if not 0 <= time <= 1:
            raise ValueError(f"time must be in [0, 1]; got {time!r}. Frame i of T is at time i / T.")
        position, windows = time * len(self.cameras), self.windows
        last = max(k for k, window in enumerate(windows) if window.start <= position or k == 0)
        weight = 1.0
        if last > 0:
            overlap = max(windows[last - 1].stop - windows[last].start, 1)
            weight = faded_in((position - windows[last].start + 0.5) / overlap)
        parts = [(windows[last - 1], 1 - weight), (windows[last], weight)] if weight < 1 else [(windows[last], 1.0)]
        return [_shown(window, position, share) for window, share in parts if share > 0]

    @torch.no_grad()
    def parts_at(self, time: float, camera: Camera | None = None) -> list[tuple[Splats, float]]:
        """The Gaussians, activated, of each window that shows at `time` in [0, 1], and its weight; see `at`."""
        return [(part.window.scene.at(part.time, camera), part.weight) for part in self.shown_at(time)]

    def at(self, time: float, camera: Camera | None = None) -> Splats:
        """The Gaussians at `time`, activated. Where two windows show, those of both, each as opaque as its weight.

        Their colors are those that `camera` sees, of scenes trained on both eyes; None: that the left eye sees.

        A ray that passes Gaussians of opacity o keeps the product of 1 - o. The opacities 1 - (1 - o) ** weight make
        that of both windows together the weighted geometric mean of the two. `render` is sharper there: it mixes the
        pictures of the two.

        Raises:
            ValueError: time is not in [0, 1].
        """
        return joined([faded(splats, weight) for splats, weight in self.parts_at(time, camera)])

    @torch.no_grad()
    def render(self, time: float, camera: Camera | None = None) -> RenderedView:
        """See `RenderedScene.render`; where two windows show, the weighted mean of the pictures of both."""
        check_camera(camera)
        seen_by = camera or self.camera_at(time)
        return rendered(self.parts_at(time, seen_by), seen_by, self.backend, self.background)

    def window_at(self, frame: int) -> tuple[SingleScene, int]:
        """The scene that shows most of a frame, and the position of that frame in it."""
        part = max(self.shown_at(frame / len(self.cameras)), key=lambda shown: shown.weight)
        return part.window.scene, frame - part.window.start

    def smoke_at(self, time: float) -> Tensor | None:
        """See `RenderedScene.smoke_at`."""
        found = [(part.window.scene.smoke, part) for part in self.shown_at(time)]
        grids = [(between(smoke, part.time * len(smoke)), part.weight) for smoke, part in found if smoke is not None]
        if not grids:
            return None
        weights = torch.tensor([weight for _, weight in grids])  # a window without smoke was not asked
        return torch.einsum("k,kijc->ijc", weights / weights.sum(), torch.stack([grid for grid, _ in grids]).cpu())

    @torch.no_grad()
    def render_many(self, times: list[float], cameras: list[Camera]) -> list[RenderedView]:
        """`render` at several times, in one call where the backend can, of cameras of one size: faster on a GPU."""
        parts = [self.parts_at(time, camera) for time, camera in zip(times, cameras, strict=True)]
        return rendered_many(parts, cameras, self.backend, self.background)

    @cached_property
    def method(self) -> Method:
        """The method that trained it."""
        return method_of(self.config)

    @property
    def background(self) -> Background:
        """Color behind everything: that of its method."""
        return self.method.background

    @property
    def backend(self) -> render.Backend:
        """Rendering backend: `rendered_by`, else the one of the config, if it works on the scene's device."""
        on_gpu = self.device.type != "cpu"
        for backend in (self.rendered_by, self.config.render.backend):
            if backend is not None and (backend in render.ON_GPU) == on_gpu:
                return backend
        return "gsplat" if on_gpu else "numba"


def with_gaussians(scene: RenderedScene, subject: Path | str = "scene") -> Scene:
    """The scene; InputError, which names `subject`, if it is a radiance field."""
    if not isinstance(scene, Scene):
        fix = "`endoprior render RUN` makes images and a video of it."
        raise input_error(subject, "a scene of Gaussians", f"a radiance field ({scene.config.method})", fix)
    return scene


def check_camera(given: object) -> None:
    """Raise InputError for what is no camera, such as a matrix; None is that of the frame."""
    if not isinstance(given, Camera | None):
        fix = "`dataclasses.replace(scene.camera_at(t), world_to_camera=M)` for a 4 x 4 matrix M."
        raise input_error("camera", "a Camera", type(given).__name__, fix)


def faded_in(place: float) -> float:
    """Weight, 0 to 1, of the later of two windows at a `place` in their overlap, in [0, 1].

    It grows in the middle half only: a window is worse near its ends, which see motion from one side (docs/log.md).
    """
    return min(max(2 * place - 0.5, 0.0), 1.0)


def _shown(window: Window, position: float, weight: float) -> Shown:
    """Args: position: in frames from the start of the sequence."""
    length = window.stop - window.start
    return Shown(window, min(max((position - window.start) / length, 0.0), 1.0), weight)
