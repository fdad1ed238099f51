"""The interface between the viewer and its content: a trained scene or a raw sequence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.types import Camera
from ..model.carry import CarriedPoints
from .mask_edits import MaskEdits
from .view_settings import Layer, ViewSettings


@dataclass(frozen=True)
class Cloud:
    """Content that a browser renders itself: P points, or Gaussians if there are covariances."""

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


class Viewable(Protocol):
    """A scene or a sequence. All methods are read-only."""

    title: str
    layers: tuple[Layer, ...]
    """Available layers; the first is the default."""
    cameras: tuple[Camera, ...]
    """The endoscope camera of each frame."""
    frames_per_second: float
    relative: bool
    """Whether lengths have no known unit."""
    span: tuple[float, float]
    """Depth range of nearly all content, seen from the endoscope, mm."""
    has_tool: bool
    """Whether the tool overlay is available."""
    mask_edits: MaskEdits | None
    """Corrections of the tool masks; None where there are no mask files to correct."""

    def picture(self, settings: ViewSettings, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) image of the selected layer and frame from `camera`."""
        ...

    def surface(self, settings: ViewSettings, camera: Camera) -> NDArray[np.float32]:
        """(H, W) z of the visible surface, mm; 0 where there is none."""
        ...

    def renders_in_browser(self, settings: ViewSettings) -> bool:
        """Whether the browser renders this view itself, from a `cloud`."""
        ...

    def cloud(self, settings: ViewSettings) -> Cloud:
        """The content for the browser to render."""
        ...

    def carry(self, points: NDArray, frames: list[int]) -> NDArray[np.float64]:
        """(T, K, 3) positions in every frame of points (K, 3), each picked in its frame of `frames`; NaN if unknown."""
        ...

    def stretch(self, points: NDArray, since: int) -> NDArray[np.float64]:
        """(T, K) largest principal stretch since a frame, around points (K, 3) of that frame; NaN where unknown."""
        ...

    def follow(self, points: NDArray, frames: list[int]) -> CarriedPoints:
        """The points of `carry` with their confidence."""
        ...

    def tracks(self) -> CarriedPoints:
        """Tracks of material points, world axes, mm; NaN where unknown; there may be none."""
        ...

    def shows(self, points: NDArray, frame: int) -> NDArray[np.bool_]:
        """(P,) whether the endoscope's image of a frame shows points (P, 3): neither tissue nor tool hides them."""
        ...

    def legend(self, settings: ViewSettings) -> str:
        """Meaning of the colors in one line; empty for plain color."""
        ...
