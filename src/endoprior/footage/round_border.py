"""Detect the round border of an endoscope image, though glare or dark tissue touches it and it moves a little.

Outline points of all sample images vote for one circle. It is then measured along radial lines in every image, and
rejected unless the images agree: the edge is sharp, on the circle, bent as the circle is, and its outside is dark.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .circle import Circle, likely_circle
from .dark_outline import Darkness, brightness, find_darkness, outline_points, reduced
from .radial import Edges, measure_edges, profiles
from .rim import measure_rim

LEAST_AGREEMENT = 0.35
"""Share of the visible circle on which the images show a border, if anything is lit there."""
CERTAIN = 0.6
"""Below this share, the border is uncertain, and only one with a sharp edge counts:"""
SHARP = 0.55
"""share of the level inside that is lost across a sharp edge, median."""
LEAST_ARC_DEGREES = 40
"""Sum of the arcs on which the images show a border."""
LEAST_HITS = 0.25
"""Share of the images that show an angle's border, of those that show anything there."""
LEAST_OUTSIDE = 0.01
"""Share of the image that a round border leaves dark."""
MOST_MARGIN = 0.1
"""Largest share of the radius for rim and movement together."""
MOST_CONTRADICTION = 0.5
"""Largest ratio of angles with an edge beside the circle to angles with an edge on it: another outline crosses it."""
MOST_UNEVEN = 0.5
"""Share of the tolerance within which four of five angles must lie: an ellipse fills the tolerance evenly."""
MOST_LIT_OUTSIDE = 0.5
"""Share of the outside that text and other displays may cover."""
BEND = (0.6, 1.4)
"""Bounds of the measured curvature of the border, in units of the circle's curvature; 0 is a straight line."""
SHARED_ANGLES = 0.25
"""Share of the angles whose errors are independent."""
BEND_ERROR = 0.2
"""Largest standard error of that curvature."""


def find_circle(images: Sequence[NDArray[np.uint8]]) -> Circle | None:
    """Detect a round border, also one of which only arcs are visible.

    Args:
        images: K of one size, (H, W, 3), at different times. Few images of a short time are enough if nothing hides
            the border in all of them.
    Returns:
        The circle, subpixel, with the measured width of its rim and how far the images agree; None without a round
        border. Vignetting, shadows, cut corners and black bars are no round border.
    """
    grays = [brightness(image) for image in images]
    small, factor = reduced(grays)
    darkness = find_darkness(small)
    if darkness is None:
        return None
    height, width = small[0].shape
    start = likely_circle(*outline_points(small, darkness), width, height)
    if start is None:
        return None
    start = Circle(start.center_x * factor, start.center_y * factor, start.radius * factor)
    edges = measure_edges(grays, start, darkness)
    agreement = _agreement(edges, grays, small, factor, darkness)
    if agreement is None or agreement < LEAST_AGREEMENT:
        return None
    if agreement < CERTAIN and np.median(edges.contrast[edges.hits]) < SHARP:
        return None
    center, drift = _rest(edges)
    rim = min(measure_rim(grays, edges, darkness) + drift, MOST_MARGIN * edges.radius)
    return Circle(float(center[0]), float(center[1]), edges.radius, rim, agreement)


def _agreement(
    edges: Edges, grays: Sequence[NDArray], small: Sequence[NDArray], factor: float, darkness: Darkness
) -> float | None:
    """Share of the visible circle that shows a border where anything is lit; None if it cannot be a round border."""
    height, width = grays[0].shape
    center = edges.centers.mean(0)
    plausible = 0.25 * min(width, height) < edges.radius < math.hypot(width, height)
    if not plausible or not (0 < center[0] < width and 0 < center[1] < height):
        return None
    supported, silent = _support(edges, grays, darkness)
    if supported.sum() * 360 / len(supported) < LEAST_ARC_DEGREES:
        return None
    if _contradicted(edges).sum() > MOST_CONTRADICTION * supported.sum():
        return None
    uneven = [abs(np.median(edges.error[edges.hits[:, a], a])) for a in np.flatnonzero(supported)]
    partial = supported.sum() < 0.8 * edges.visible.sum()  # an outline that stays near the circle everywhere is one
    if partial and np.quantile(uneven, 0.8) > MOST_UNEVEN * edges.tolerance_px:
        return None
    bend, error = measured_bend(edges, supported)
    if not (BEND[0] < bend < BEND[1] and error < BEND_ERROR):
        return None
    wide = Circle(center[0] / factor, center[1] / factor, 1.02 * edges.radius / factor)
    outside = ~wide.mask(small[0].shape[1], small[0].shape[0])
    if outside.mean() < LEAST_OUTSIDE:
        return None
    lit = np.median(np.stack(small)[:, outside], axis=0) > darkness.level + 2 * darkness.step
    if lit.mean() > MOST_LIT_OUTSIDE:
        return None
    counted = edges.visible & (supported | ~silent)
    return float(supported.sum() / max(counted.sum(), 1))


def _support(edges: Edges, grays: Sequence[NDArray], darkness: Darkness) -> tuple[NDArray, NDArray]:
    """(A,) True where enough images show the border; (A,) True where it is dark inside in all images."""
    depths = np.linspace(0.01, 0.04, 7) * edges.radius
    inner = profiles(grays, [edges.circle(k) for k in range(len(grays))], edges.angles, depths)
    with np.errstate(invalid="ignore"):
        lit = np.nan_to_num(inner).mean(2) > darkness.level + 2 * darkness.step
    lit |= edges.hits
    shown = lit.sum(0)
    supported = edges.visible & (edges.hits.sum(0) >= np.maximum(LEAST_HITS * shown, 1)) & (shown > 0)
    return supported, shown == 0


def _contradicted(edges: Edges) -> NDArray[np.bool_]:
    """(A,) True where half of the images show an edge in one place that is not on the circle."""
    error = np.where(edges.visible, edges.error, np.nan)
    shown = np.isfinite(error).mean(0) >= 0.5
    found = np.zeros(len(edges.angles), bool)
    some = error[:, shown]
    middle = np.nanmedian(some, axis=0)
    spread = np.nanmedian(np.abs(some - middle), axis=0)
    found[shown] = (np.abs(middle) >= edges.tolerance_px) & (spread < edges.tolerance_px)
    return found


def measured_bend(edges: Edges, supported: NDArray[np.bool_]) -> tuple[float, float]:
    """Curvature of the border in units of the circle's, and its standard error.

    Each connected arc may have its own position and direction; only how it bends counts: 1 for the circle, 0 for the
    straight sides of a polygon.
    """
    error = np.where(edges.hits, edges.error, np.nan)
    seen = np.flatnonzero(supported)
    values = np.array([np.nanmedian(error[:, a]) for a in seen])
    along = edges.radius * edges.angles[seen]
    top = bottom = squares = 0.0
    freedom = 0
    for arc in _arcs(seen, len(supported)):
        # A circle's outline lies on the circle. A straight line through it lies s^2 / 2R outside of it at s.
        s = np.unwrap(along[arc] / edges.radius) * edges.radius
        s = s - s.mean()
        basis = np.stack([np.ones_like(s), s], 1)
        bent = s * s / (2 * edges.radius)
        rest = np.stack([bent, values[arc]], 1)
        rest = rest - basis @ np.linalg.lstsq(basis, rest, rcond=None)[0]
        top, bottom = top + rest[:, 0] @ rest[:, 1], bottom + rest[:, 0] @ rest[:, 0]
        squares, freedom = squares + rest[:, 1] @ rest[:, 1], freedom + len(arc) - 2
    if bottom <= 0 or freedom < 3:
        return math.nan, math.inf
    straight = top / bottom
    variance = max(squares - straight * top, 0.0) / freedom + 0.05**2
    return 1 - float(straight), float(np.sqrt(variance / bottom / SHARED_ANGLES))


def _arcs(seen: NDArray[np.int_], count: int) -> list[NDArray[np.int_]]:
    """Positions in `seen` (sorted angles of `count`) of each arc without a gap of more than 3, and at least 6 long.

    An arc is at most 30 angles long: many sides of a polygon would average out.
    """
    if not len(seen):
        return []
    gaps = np.diff(np.r_[seen, seen[0] + count])
    start = (int(np.argmax(gaps)) + 1) % len(seen)
    order = np.roll(np.arange(len(seen)), -start)
    steps = np.diff(seen[order]) % count
    parts = np.split(order, np.flatnonzero(steps > 3) + 1)
    parts = [piece for part in parts for piece in np.array_split(part, -(-len(part) // 30))]
    return [part for part in parts if len(part) >= 6]


def _rest(edges: Edges) -> tuple[NDArray[np.float64], float]:
    """Mean center, px, and the largest distance of an image's center from it; images with few edges do not count."""
    shown = edges.hits.sum(1)
    good = shown >= max(0.3 * np.quantile(shown, 0.9), 10)
    centers = edges.centers[good] if good.any() else edges.centers
    low, high = np.quantile(centers, [0.02, 0.98], axis=0)
    center = (low + high) / 2
    return center, float(np.quantile(np.hypot(*(centers - center).T), 0.98))
