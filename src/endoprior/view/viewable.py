"""What the viewer shows, a trained scene or a raw sequence, and the settings of the view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.types import Camera
from ..model.carry import CarriedPoints
from .mask_edits import MaskEdits

Layer = Literal["color", "depth", "alpha", "displacement", "stretch", "prior", "support", "frame", "difference"]
"""`color`, `depth` and `alpha` as rendered; `displacement` and `stretch` since a reference frame; `prior` the
texture-prior score; `support` the share of the training frames that show the tissue; `frame` the original;
`difference` rendered minus original."""

SLOW_MS = 60.0
"""If rendering at full size takes longer, images are rendered at half size while something moves."""
IDLE_SECONDS = 0.25
"""After this time without motion, the image is rendered again at full size."""


@dataclass(frozen=True)
class ViewSettings:
    """All settings of the panel. The viewports of the browsers are not part of it."""

    frame: int = 0
    """0-based frame of the sequence."""
    layer: Layer = "color"
    endoscope: bool = True
    """Use the camera of the sequence in this frame; False: the camera of the browser."""
    riding: bool = True
    """A camera of the browser moves with the endoscope from frame to frame; False: it stands still."""
    in_browser: bool = False
    """Send the Gaussians to the browser and render there (smooth); False: render on the server (exact)."""
    points: bool = False
    """Small opaque dots in place of splats."""
    tool: bool = False
    """Show the tool of the input frame on top, with an outline."""
    correcting: bool = False
    """Show the tool mask in color, to correct it; only with the endoscope camera of a sequence."""
    near: float = 0.0
    """Smallest depth to render, mm."""
    far: float = float("inf")
    """Largest depth to render, mm."""
    since: int = 0
    """Reference frame of displacement and stretch."""
    tracks: bool = False
    """Show tracks of material points over the previous frames."""


def frame_due(start: int, seconds: float, frames_per_second: float, total: int) -> int:
    """The frame to show `seconds` after `start` was shown; playback repeats."""
    return (start + int(seconds * frames_per_second)) % total


def shrink_factor(idle_seconds: float, full_ms: float) -> int:
    """Divisor of the image size: 2 while something moves and rendering at full size is slow, else 1.

    Args:
        idle_seconds: time since the last motion.
        full_ms: rendering time of the last image of full size.
    """
    return 2 if idle_seconds < IDLE_SECONDS and full_ms > SLOW_MS else 1


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

    def surface(self, settings: ViewSettings, camera: Camera) -> NDArray[np.float32]:
        """(H, W) z of the visible surface, mm; 0 where there is none."""

    def renders_in_browser(self, settings: ViewSettings) -> bool:
        """Whether the browser renders this view itself, from a `cloud`."""

    def cloud(self, settings: ViewSettings) -> Cloud:
        """The content for the browser to render."""

    def stretch(self, points: NDArray, since: int) -> NDArray[np.float64]:
        """(T, K) largest principal stretch since a frame, around points (K, 3) of that frame; NaN where unknown."""

    def follow(self, points: NDArray, frames: list[int]) -> CarriedPoints:
        """Points (K, 3), each picked in its frame of `frames`, in every frame; NaN where unknown."""

    def tracks(self) -> CarriedPoints:
        """Tracks of material points, world axes, mm; NaN where unknown; there may be none."""

    def shows(self, points: NDArray, frame: int) -> NDArray[np.bool_]:
        """(P,) whether the endoscope's image of a frame shows points (P, 3): neither tissue nor tool hides them."""

    def legend(self, settings: ViewSettings) -> str:
        """Meaning of the colors in one line; empty for plain color."""
