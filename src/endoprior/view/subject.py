"""What can be looked at: the seam between the viewer and a trained scene or a raw sequence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.types import Camera
from .session import Layer, Look


@dataclass(frozen=True)
class Cloud:
    """What a browser draws itself: P points, or Gaussians if they have extent."""

    points: NDArray[np.float32]
    """(P, 3) world axes, mm."""
    colors: NDArray[np.uint8]
    """(P, 3)."""
    covariances: NDArray[np.float32] | None
    """(P, 3, 3) mm^2; None for points."""
    opacities: NDArray[np.float32] | None
    """(P,) in [0, 1]; None for points."""
    size: float
    """Width of a point, mm."""


class Subject(Protocol):
    """A scene or a sequence. Nothing here changes it."""

    title: str
    layers: tuple[Layer, ...]
    """What it can show; the first is shown first."""
    cameras: tuple[Camera, ...]
    """The endoscope's, one per frame."""
    frames_per_second: float
    relative: bool
    """Lengths have no known unit."""
    span: tuple[float, float]
    """Depths, mm, between which nearly all of it lies, seen by the endoscope."""
    has_tool: bool
    """Whether the tool can be laid over."""

    def picture(self, look: Look, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3): the layer of `look` at its frame, as `camera` sees it."""
        ...

    def surface(self, look: Look, camera: Camera) -> NDArray[np.float32]:
        """(H, W) z of the surface that the picture shows, mm; 0 where there is none."""
        ...

    def sent(self, look: Look) -> bool:
        """Whether the browser draws this look itself, from a `cloud`."""
        ...

    def cloud(self, look: Look) -> Cloud:
        """What the browser draws."""
        ...

    def carry(self, points: NDArray, frames: list[int]) -> NDArray[np.float64]:
        """(T, K, 3): where points (K, 3), each picked in its frame of `frames`, are in every frame; NaN if unknown."""
        ...

    def tracks(self) -> NDArray[np.float64]:
        """(T, P, 3) material points worth showing, world axes, mm; NaN where unknown; P may be 0."""
        ...

    def legend(self, look: Look) -> str:
        """What the colors mean, in one line; empty where they are plain colors."""
        ...
