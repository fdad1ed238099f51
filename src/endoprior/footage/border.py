"""Detect borders around the endoscope image: black bars, console strips, the round border of a lens.

Shared letters: `K` sample images of one clip, (H, W, 3) uint8 each. Borders are the regions that stay black or static
in all samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

BLACK_LEVEL = 28
"""Levels 0..255 below this are black, including limited-range video with coding noise."""
MIN_STRIP_PX = 3
"""Thinner strips are ignored; they can be coding noise."""
MAX_STRIP_FRACTION = 0.25
"""Largest share of the image for one strip."""
STATIC_RATIO = 0.3
"""The change over time of a strip is below this share of the change in the image center ..."""
STRIP_CHROMA = 40
"""... and a strip is gray: the channels of half of its pixels differ by less than this."""
EDGE_SHARE = 0.55
"""Share of the strip's edge with a brightness step: strips have straight edges, shadows do not."""
EDGE_STEP = 12
"""Smallest brightness step, levels."""
CIRCLE_RESIDUAL = 0.012
"""Largest median distance of border points from the fitted circle, in radii."""


@dataclass(frozen=True)
class Strips:
    """Rows and columns at each side that are outside of the endoscope image, px."""

    top: int
    bottom: int
    left: int
    right: int

    def __bool__(self) -> bool:
        return any((self.top, self.bottom, self.left, self.right))


@dataclass(frozen=True)
class Circle:
    """The round border of the endoscope image, px; the center of the top-left pixel is (0.5, 0.5)."""

    center_x: float
    center_y: float
    radius: float

    def mask(self, width: int, height: int, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """(H, W) True inside the circle with its radius reduced by `margin_px`."""
        x = np.arange(width) + 0.5 - self.center_x
        y = np.arange(height)[:, None] + 0.5 - self.center_y
        return x * x + y * y < (self.radius - margin_px) ** 2


@dataclass(frozen=True)
class Outline:
    """Where the endoscope image ends, judging by the images alone."""

    strips: Strips
    circle: Circle | None
    in_strip: NDArray[np.bool_]
    """(H, W) True in the strips."""
    outside: NDArray[np.bool_]
    """(H, W) True outside of the circle."""


def find_outline(images: Sequence[NDArray[np.uint8]]) -> Outline:
    """Detect strips and a round border in (H, W, 3) sample images."""
    height, width = images[0].shape[:2]
    strips, circle = find_strips(images), find_circle(images)
    in_strip = np.ones((height, width), bool)
    in_strip[strips.top : height - strips.bottom, strips.left : width - strips.right] = False
    outside = ~circle.mask(width, height) if circle else np.zeros((height, width), bool)
    return Outline(strips, circle, in_strip, outside)


def masked_border(
    outline: Outline, images: Sequence[NDArray[np.uint8]], tissue_masks: Iterable[NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    """(H, W) True where no frame is tissue and no image shows anything: black, or beyond the outline.

    Args:
        images: sample images, (H, W, 3).
        tissue_masks: (H, W) each, of every frame.
    """
    masked = outline.in_strip | outline.outside | (np.maximum.reduce(images).max(-1) < BLACK_LEVEL)
    for tissue in tissue_masks:
        masked &= ~tissue
    return masked


def find_strips(images: Sequence[NDArray[np.uint8]]) -> Strips:
    """Detect black bars and static gray console strips at the sides.

    Args:
        images: K of one size, at different times; from a single image only black bars are detected.
    """
    grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in images]
    mean = sum(grays) / len(grays)
    change = np.sqrt(sum((gray - mean) ** 2 for gray in grays) / len(grays))
    low = np.maximum.reduce([image.max(-1) for image in images])
    chroma = sum(image.max(-1) - image.min(-1).astype(np.float32) for image in images) / len(images)
    middle = tuple(slice(n // 4, n - n // 4) for n in low.shape)
    central_change = float(np.median(change[middle]))
    found = []
    for turns in (0, 2, 1, 3):  # turned so that the side in question is on top: top, bottom, right, left
        maps = (np.rot90(m, turns) for m in (low, chroma, change, mean))
        found.append(_strip_on_top(*maps, central_change))
    return Strips(top=found[0], bottom=found[1], left=found[3], right=found[2])


def _strip_on_top(
    low: NDArray[np.uint8], chroma: NDArray, change: NDArray, mean: NDArray, central_change: float
) -> int:
    """Number of rows of a strip at the top of these (H, W) maps, 0 for none."""
    limit = int(MAX_STRIP_FRACTION * len(low))
    black = np.quantile(low[: limit + 1], 0.98, axis=1) < BLACK_LEVEL
    static = np.quantile(change[: limit + 1], 0.8, axis=1) < STATIC_RATIO * central_change  # False for one image
    gray = np.median(chroma[: limit + 1], axis=1) < STRIP_CHROMA
    belongs = black | (static & gray)
    rows = limit + 1 if belongs.all() else int(np.argmin(belongs))
    if rows < MIN_STRIP_PX or rows > limit:
        return 0
    # A row of coding noise can lie between strip and image.
    jumps = [np.abs(mean[rows + d] - mean[rows - 1]) > EDGE_STEP for d in (0, 1) if rows + d < len(mean)]
    return rows if max(jump.mean() for jump in jumps) > EDGE_SHARE else 0


def find_circle(images: Sequence[NDArray[np.uint8]]) -> Circle | None:
    """Detect a round border: the corners stay black and the lit region has a circular outline.

    Args:
        images: K of one size, at different times.
    """
    low = np.stack(images).max(-1).max(0)
    height, width = low.shape
    lit = cv2.medianBlur(low, 5) >= BLACK_LEVEL
    side = max(min(height, width) // 40, 2)
    corners = [lit[y, x] for y in (slice(side), slice(-side, None)) for x in (slice(side), slice(-side, None))]
    if sum(not corner.any() for corner in corners) < 2:
        return None
    points = _outline(lit)
    if len(points) < 0.2 * height:
        return None
    circle = _fit_circle(points)
    residuals = np.abs(np.hypot(*(points - circle[:2]).T) - circle[2])
    points = points[residuals < np.maximum(3 * np.median(residuals), 2)]  # dark tissue touches the border
    circle = _fit_circle(points)
    residual = float(np.median(np.abs(np.hypot(*(points - circle[:2]).T) - circle[2])))
    found = Circle(*(float(v) for v in circle))
    outside = ~found.mask(width, height, -0.02 * found.radius)
    diagonal = float(np.hypot(width, height))
    plausible = 0.25 * min(width, height) < found.radius < diagonal and outside.mean() > 0.01
    if not plausible or residual > max(CIRCLE_RESIDUAL * found.radius, 1.0) or lit[outside].mean() > 0.05:
        return None
    return found


def _outline(lit: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(P, 2) x, y of the ends of rows and columns of `lit` (H, W), except where the image edge cuts the lit region."""
    found = []
    for swapped, image in ((False, lit), (True, lit.T)):
        some, across = np.flatnonzero(image.any(1)), np.flatnonzero(image.any(0))
        first, last = image.argmax(1)[some], image.shape[1] - image[:, ::-1].argmax(1)[some]
        for along, keep in ((first, first > across[0] + 2), (last, last < across[-1] - 1)):
            pair = np.stack([along[keep], some[keep] + 0.5], 1).astype(np.float64)
            found.append(pair[:, ::-1] if swapped else pair)
    return np.concatenate(found)


def _fit_circle(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Center x, y and radius of the circle through (P, 2) points, by linear least squares on x^2 + y^2."""
    a = np.c_[2 * points, np.ones(len(points))]
    x, y, c = np.linalg.lstsq(a, (points**2).sum(1), rcond=None)[0]
    return np.array([x, y, np.sqrt(max(c + x * x + y * y, 0.0))])
