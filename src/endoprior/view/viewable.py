"""The settings of the view, and what the viewer gets of a trained scene or a raw sequence."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..model.uncertainty import PointErrors

Layer = Literal["color", "depth", "alpha", "displacement", "stretch", "prior", "support", "frame", "difference"]
"""`color`, `depth` and `alpha` as rendered; `displacement` and `stretch` since a reference frame; `prior` the
texture-prior score; `support` the share of the training frames that show the tissue; `frame` the original;
`difference` rendered minus original."""

SLOW_MS = 60.0
"""If rendering at full size takes longer, images are rendered at half size while something moves."""
IDLE_SECONDS = 0.25
"""After this time without motion, the image is rendered again at full size."""


@dataclass(frozen=True)
class FollowedPoints:
    """Points in every frame."""

    positions: NDArray[np.floating]
    """(T, K, 3) world axes, mm; NaN where unknown."""
    errors: PointErrors | None = None
    """How far they may be from the truth; None: they are the truth."""

    @property
    def confidence(self) -> NDArray[np.float32]:
        """(T, K) in where they are, in [0, 1]."""
        return np.ones(self.positions.shape[:2], np.float32) if self.errors is None else self.errors.confidence


@dataclass(frozen=True)
class ViewSettings:
    """All settings of the panel. The viewports of the browsers are not part of it."""

    frame: int = 0
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
    smoke: bool = False
    """Show the smoke that the endoscope saw, in its view; False: the tissue alone."""
    correcting: bool = False
    """Show the tool mask in color, to correct it; only with the endoscope camera of a sequence."""
    near: float = 0.0
    """Smallest depth to render, mm; `far` is the largest."""
    far: float = float("inf")
    since: int = 0
    """Reference frame of displacement and stretch."""
    tracks: bool = False
    """Show tracks of material points over the previous frames."""


def frame_due(start: int, seconds: float, frames_per_second: float, total: int) -> int:
    """The frame to show `seconds` after `start` was shown; playback repeats."""
    return (start + int(seconds * frames_per_second)) % total


def shrink_factor(idle_seconds: float, full_ms: float) -> int:
    """Divisor of the image size: 2 while something moves and an image of full size takes long (`full_ms`), else 1."""
    return 2 if idle_seconds < IDLE_SECONDS and full_ms > SLOW_MS else 1


@dataclass(frozen=True)
class Cloud:
    """Content that a browser renders itself: P points of `size` mm, or Gaussians if there are covariances."""

    points: NDArray[np.float32]
    """(P, 3) world axes, mm."""
    colors: NDArray[np.uint8]
    """(P, 3)."""
    size: float = 0.0
    covariances: NDArray[np.float32] | None = None
    """(P, 3, 3) mm^2."""
    opacities: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    """(P,) in [0, 1], of Gaussians."""
