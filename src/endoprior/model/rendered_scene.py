"""What every scene is: the tissue at any time, rendered from any viewpoint. One of Gaussians is a `scene.Scene`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from .. import render
from ..core.checks import InputError, input_error
from ..core.config import Config
from ..core.types import Camera, Fingerprints, RenderedView, Splats
from .photometric import behind_smoke


class RenderedScene(ABC):
    """What renders the tissue at any time from any viewpoint. Frame i of T was taken at time i / T."""

    config: Config
    cameras: tuple[Camera, ...]
    """Camera of each frame of the sequence."""
    frames_per_second: float
    lengths_are_relative: bool
    """Whether the scale of the sequence's depth was assumed: lengths are then not in mm."""
    trained_on: Fingerprints | None = None
    """Those of the sequence; None: not known, as in scenes of earlier versions, or while it is trained."""

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
            backend: renders Gaussians there; None: as before, if that works there.
            fp16_planes: HexPlane in half precision, half the memory and faster: for rendering, cannot be saved.
        """

    @abstractmethod
    def save(self, path: str | Path) -> None:
        """Write the scene as safetensors, completely or not at all.

        Raises:
            ValueError: its planes are in half precision.
        """

    def with_fingerprints(self, trained_on: Fingerprints) -> Self:
        """This scene, which says on which sequence it was trained."""
        scene = copy(self)
        vars(scene)["trained_on"] = trained_on  # of a frozen dataclass too
        return scene

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
        """A scene without any Gaussians is a scene too."""
        return True

    def __len__(self) -> int:
        """Number of Gaussians in all windows.

        Raises:
            InputError: it is a radiance field, which has none.
        """
        raise no_gaussians(self)

    def at(self, time: float, camera: Camera | None = None) -> Splats:
        """The Gaussians at `time`, activated; see `Scene.at`.

        Raises:
            InputError: it is a radiance field, which has none.
        """
        del time, camera  # for subclasses
        raise no_gaussians(self)

    def render_many(self, times: list[float], cameras: list[Camera]) -> list[RenderedView]:
        """`render` at several times, one camera each."""
        return [self.render(time, camera) for time, camera in zip(times, cameras, strict=True)]

    def smoke_at(self, _time: float) -> Tensor | None:
        """(I, J, 2) gain and veil of the smoke that the endoscope sees at a time: see `photometric`; None: none."""
        return None

    def render_with_smoke(self, time: float, camera: Camera | None = None) -> RenderedView:
        """`render` with the smoke of that time, as frames show it."""
        return behind_smoke(self.render(time, camera), self.smoke_at(time))

    @staticmethod
    def check_time(time: float) -> None:
        """Raise ValueError unless `time` is in [0, 1]."""
        if not 0 <= time <= 1:
            raise ValueError(f"time must be in [0, 1]; got {time!r}. Frame i of T is at time i / T.")

    def frame_time(self, frame: int) -> float:
        """Time of a frame of the sequence, in [0, 1)."""
        return frame / len(self.cameras)

    def camera_at(self, time: float) -> Camera:
        """Camera of the frame nearest in time."""
        nearest = round(time * len(self.cameras))
        return self.cameras[min(max(nearest, 0), len(self.cameras) - 1)]


def no_gaussians(scene: RenderedScene, subject: Path | str = "scene") -> InputError:
    """The error, which names `subject`, where Gaussians are needed and the scene is a radiance field."""
    fix = "`endoprior render RUN` makes images and a video of it."
    return input_error(subject, "a scene of Gaussians", f"a radiance field ({scene.config.method})", fix)


def check_camera(given: object) -> None:
    """Raise InputError for what is no camera, such as a matrix; None is that of the frame."""
    if not isinstance(given, Camera | None):
        fix = "`dataclasses.replace(scene.camera_at(t), world_to_camera=M)` for a 4 x 4 matrix M."
        raise input_error("camera", "a Camera", type(given).__name__, fix)
