"""A scene of several windows, each in a file of its own; few of them are in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch

from .. import render
from ..core.config import Config
from ..core.types import Camera, Fingerprints
from ..system.arrays_file import save_arrays
from ..system.memory import BoundedCache
from .scene import Scene, SingleScene, Window
from .scene_facts import camera_arrays, scene_facts

WINDOWS_FORMAT = "endoprior-windows-1"
"""Name and version of the file that lists the windows, in its metadata."""
CACHE_BYTES = 2**28
"""Memory of the windows that are kept; a window of 33,000 Gaussians and 60 frames has 60 MB."""


@dataclass(frozen=True)
class Span:
    """Where a window is, and how large."""

    start: int
    stop: int
    num_gaussians: int


@dataclass(frozen=True)
class WindowedScene(Scene):
    """A scene of several windows."""

    config: Config
    cameras: tuple[Camera, ...]
    frames_per_second: float
    spans: tuple[Span, ...]
    """In order; each starts after the one before, ends after it, and overlaps the next one only."""
    read: Callable[[int], SingleScene]
    """Reads the scene of window k."""
    lengths_are_relative: bool = False
    rendered_by: render.Backend | None = None
    device_name: str = "cpu"
    """Device that windows are moved to when they are read."""
    fp16_planes: bool = False
    trained_on: Fingerprints | None = None

    def __len__(self) -> int:
        return sum(span.num_gaussians for span in self.spans)

    @cached_property
    def _scenes(self) -> BoundedCache[SingleScene]:
        return BoundedCache(CACHE_BYTES, lambda scene: sum(value.nbytes for value in scene.gaussians.tensors.values()))

    @cached_property
    def windows(self) -> Sequence[Window]:
        """See `Scene.windows`."""
        return [Window(span.start, span.stop, self._reader(k)) for k, span in enumerate(self.spans)]

    def _reader(self, k: int) -> Callable[[], SingleScene]:
        def read() -> SingleScene:
            return self.read(k).to(self.device, backend=self.rendered_by, fp16_planes=self.fp16_planes)

        return lambda: self._scenes.get(k, read)

    @property
    def device(self) -> torch.device:
        """See `Scene.device`."""
        return torch.device(self.device_name)

    def to(
        self, device: torch.device | str, *, backend: render.Backend | None = None, fp16_planes: bool = False
    ) -> WindowedScene:
        """See `Scene.to`."""
        backend = backend or self.rendered_by
        wanted = {"device_name": str(device), "rendered_by": backend, "fp16_planes": fp16_planes}
        return self if all(getattr(self, name) == value for name, value in wanted.items()) else replace(self, **wanted)

    def changed(self, change: Callable[[SingleScene, Window], SingleScene]) -> WindowedScene:
        """See `Scene.changed`: each window is changed when it is read."""
        windows = self.windows
        return replace(self, read=lambda k: change(windows[k].scene, windows[k]))

    def save(self, path: str | Path) -> None:
        """See `Scene.save`: the list of windows, and the windows below `windows/` beside it."""
        path = Path(path)
        for k, window in enumerate(self.windows):
            file = window_file(path, k)
            file.parent.mkdir(parents=True, exist_ok=True)
            window.scene.save(file)
        save_index(path, self)


def window_file(path: Path, k: int) -> Path:
    """The file of window k of the scene whose list of windows is at `path`."""
    return path.parent / "windows" / f"{k:03d}" / "scene.safetensors"


def save_index(path: Path, scene: WindowedScene) -> None:
    """Write the list of windows only; the windows are in place."""
    spans = torch.tensor([[span.start, span.stop, span.num_gaussians] for span in scene.spans], dtype=torch.int64)
    save_arrays(path, camera_arrays(scene.cameras) | {"windows": spans}, scene_facts(scene), WINDOWS_FORMAT)
