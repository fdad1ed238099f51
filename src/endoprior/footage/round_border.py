"""Detect the round border of an endoscope image, though glare or dark tissue touches it and it moves a little.

Outlines of the dark regions of all sample images vote for one circle (`dark_outline`). It is then measured along radial
lines in every image, and rejected unless the images agree: the edge is sharp, on the circle, bent as the circle is, and
its outside is dark. `K` sample images of one clip, (H, W); `A` angles; `D` depths inside of the circle, px.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .components import Image, Mask
from .dark_outline import Circle, Points, brightness, find_darkness, likely_circle, outline_points, reduced

MIN_AGREEMENT = 0.35  # Share of the visible circle on which the images show a border, if anything is lit there
CERTAIN = 0.6  # Below this share, the border is uncertain, and only one with a sharp edge counts:
SHARP = 0.55  # share of the level inside that is lost across a sharp edge, median
MIN_ARC_DEGREES = 40  # Sum of the arcs on which the images show a border
MIN_HITS = 0.25  # Share of the images that show an angle's border, of those that show anything there
MIN_OUTSIDE = 0.01  # Share of the image that a round border leaves dark
MAX_MARGIN = 0.1  # Largest share of the radius for rim and movement together
MAX_CONTRADICTION = 0.5
"""Largest ratio of angles with an edge beside the circle to angles with an edge on it: another outline crosses it."""
MAX_UNEVEN = 0.5
"""Share of the tolerance within which four of five angles must lie: an ellipse fills the tolerance evenly."""
MAX_LIT_OUTSIDE = 0.5  # Share of the outside that text and other displays may cover
BEND = (0.6, 1.4)  # Bounds of the border's curvature, in units of the circle's; 0 is a straight line
SHARED_ANGLES = 0.25  # Share of the angles whose errors are independent
BEND_ERROR = 0.2  # Largest standard error of that curvature
ANGLES = 360
SEARCH = (0.02, 0.01, 0.005)
"""Standard deviation of the search around the circle, in radii: one round each, which reaches three times as far."""
EDGE_WIDTH = 0.006  # Length over which levels are averaged on both sides of an edge, in radii
MIN_EDGE_PX = 1.5
MIN_CONTRAST = 0.4  # The level outside of an edge is lower by at least this share of the level inside
DRIFT = 0.005  # Typical movement of the border in the image, in radii
ANGLE_WEIGHT = 0.125  # Weight of one angle: neighbors have the same error
MIN_RIM, MIN_RIM_PX = 0.005, 1.0  # Smallest rim, in radii and px
MAX_RIM = 0.06  # Largest rim, in radii
TISSUE = (0.06, 0.12)  # Depths, in radii, that show tissue in all endoscopes
RADIAL = 1.6  # In a rim the level changes this many times more across the border than deeper in the image
FADED = 0.7  # A rim is darker than this share of the level that tissue's own fall-off leads to


@dataclass(frozen=True)
class Edges:
    """The round border in every image."""

    grays: Sequence[Image]
    black: float  # Level of what is dark
    step: float  # Levels above it that are not black
    radius: float
    centers: Points  # (K, 2) px
    angles: NDArray[np.float64]  # (A,) radians; 0 points right, pi/2 down
    error: NDArray[np.float64]
    """(K, A) distance of the edge from the image's circle, px, positive outside; NaN without an edge."""
    contrast: NDArray[np.float64]  # (K, A) share 0..1 of the level inside that is lost across the edge; NaN without one
    visible: Mask  # (A,) True where the circle lies in the image

    @property
    def tolerance_px(self) -> float:
        """Largest error of an edge that lies on the circle."""
        return max(0.005 * self.radius, 1.5)

    @property
    def hits(self) -> Mask:
        """(K, A) True where the edge lies on the circle."""
        return np.abs(np.nan_to_num(self.error, nan=np.inf)) < self.tolerance_px

    def profiles(self, depths: NDArray[np.float64]) -> NDArray[np.float32]:
        """(K, A, D) levels along radial lines."""
        return _profiles(self.grays, self.centers, self.radius, self.angles, depths)


def find_circle(images: Sequence[Image]) -> Circle | None:
    """Detect a round border, also one of which only arcs are visible, in K images (H, W, 3) of one size. Few images of
    a short time are enough if nothing hides the border in all of them. Vignetting, shadows, cut corners and black bars
    are no round border.
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
    x, y, radius = start * factor
    edges = _measure_edges(grays, x, y, radius, darkness.level, darkness.step)
    agreement = _agreement(edges, small, factor)
    if agreement < MIN_AGREEMENT or (agreement < CERTAIN and np.median(edges.contrast[edges.hits]) < SHARP):
        return None
    # Where the border rests, and how far it moves; images with few edges do not count.
    shown = edges.hits.sum(1)
    good = shown >= max(0.3 * np.quantile(shown, 0.9), 10)
    centers = edges.centers[good] if good.any() else edges.centers
    low, high = np.quantile(centers, [0.02, 0.98], axis=0)
    center = (low + high) / 2
    drift = float(np.quantile(np.hypot(*(centers - center).T), 0.98))
    rim = min(_measure_rim(edges) + drift, MAX_MARGIN * edges.radius)
    return Circle(float(center[0]), float(center[1]), edges.radius, rim, agreement)


def _agreement(edges: Edges, small: Sequence[Image], factor: float) -> float:
    """Share of the visible circle that shows a border where anything is lit; 0 if it cannot be a round border."""
    height, width = edges.grays[0].shape
    x, y = edges.centers.mean(0)
    plausible = 0.25 * min(width, height) < edges.radius < math.hypot(width, height)
    if not plausible or not (0 < x < width and 0 < y < height):
        return 0.0
    supported, silent = _support(edges)
    if supported.sum() * 360 / len(supported) < MIN_ARC_DEGREES:
        return 0.0
    if _contradicted(edges).sum() > MAX_CONTRADICTION * supported.sum() or not _is_bent(edges, supported):
        return 0.0
    wide = Circle(x / factor, y / factor, 1.02 * edges.radius / factor)
    outside = ~wide.mask(small[0].shape[1], small[0].shape[0])
    if outside.mean() < MIN_OUTSIDE:
        return 0.0
    lit = np.median(np.stack(small)[:, outside], axis=0) > edges.black + 2 * edges.step
    if lit.mean() > MAX_LIT_OUTSIDE:
        return 0.0
    counted = edges.visible & (supported | ~silent)
    return float(supported.sum() / max(counted.sum(), 1))


def _support(edges: Edges) -> tuple[Mask, Mask]:
    """(A,) True where enough images show the border; (A,) True where it is dark inside in all images."""
    inner = edges.profiles(np.linspace(0.01, 0.04, 7) * edges.radius)
    with np.errstate(invalid="ignore"):
        lit = np.nan_to_num(inner).mean(2) > edges.black + 2 * edges.step
    shown = (lit | edges.hits).sum(0)
    enough = edges.hits.sum(0) >= np.maximum(MIN_HITS * shown, 1)
    return edges.visible & enough & (shown > 0), shown == 0


def _contradicted(edges: Edges) -> Mask:
    """(A,) True where half of the images show an edge in one place that is not on the circle."""
    error = np.where(edges.visible, edges.error, np.nan)
    shown = np.isfinite(error).mean(0) >= 0.5
    some = error[:, shown]
    middle = np.nanmedian(some, axis=0)
    spread = np.nanmedian(np.abs(some - middle), axis=0)
    found = np.zeros(len(shown), bool)
    found[shown] = (np.abs(middle) >= edges.tolerance_px) & (spread < edges.tolerance_px)
    return found


def _is_bent(edges: Edges, supported: Mask) -> bool:
    """Whether the border lies on the circle as an ellipse does not, and bends as the sides of a polygon do not. Each
    arc may have its own position and direction; only how it bends counts, in units of the circle's curvature.
    """
    error = np.where(edges.hits, edges.error, np.nan)
    seen = np.flatnonzero(supported)
    values = np.array([np.nanmedian(error[:, a]) for a in seen])
    partial = supported.sum() < 0.8 * edges.visible.sum()  # an outline that stays near the circle everywhere is one
    if partial and np.quantile(np.abs(values), 0.8) > MAX_UNEVEN * edges.tolerance_px:
        return False
    top = bottom = squares = 0.0
    freedom = 0
    for arc in _arcs(seen, len(supported)):
        # A circle's outline lies on the circle. A straight line through it lies s^2 / 2R outside of it at s.
        s = np.unwrap(edges.radius * edges.angles[seen[arc]] / edges.radius) * edges.radius
        s = s - s.mean()
        basis = np.stack([np.ones_like(s), s], 1)
        bent = s * s / (2 * edges.radius)
        rest = np.stack([bent, values[arc]], 1)
        rest = rest - basis @ np.linalg.lstsq(basis, rest, rcond=None)[0]
        top, bottom = top + rest[:, 0] @ rest[:, 1], bottom + rest[:, 0] @ rest[:, 0]
        squares, freedom = squares + rest[:, 1] @ rest[:, 1], freedom + len(arc) - 2
    if bottom <= 0 or freedom < 3:
        return False
    straight = top / bottom
    variance = max(squares - straight * top, 0.0) / freedom + 0.05**2
    bend, error = 1 - float(straight), math.sqrt(variance / bottom / SHARED_ANGLES)
    return BEND[0] < bend < BEND[1] and error < BEND_ERROR


def _arcs(seen: NDArray[np.intp], count: int) -> list[NDArray[np.intp]]:
    """Positions in `seen` (sorted angles of `count`) of each arc without a gap of more than 3, and at least 6 long; at
    most 30 long, because many sides of a polygon would average out.
    """
    gaps = np.diff(np.r_[seen, seen[0] + count])
    order = np.roll(np.arange(len(seen)), -(int(np.argmax(gaps)) + 1))
    steps = np.diff(seen[order]) % count
    parts = np.split(order, np.flatnonzero(steps > 3) + 1)
    parts = [piece for part in parts for piece in np.array_split(part, -(-len(part) // 30))]
    return [part for part in parts if len(part) >= 6]


def _profiles(grays: Sequence[Image], centers: Points, radius: float, angles: NDArray, depths: NDArray) -> NDArray:
    """(K, A, D) levels along radial lines of circles with (K, 2) centers; NaN outside of the image."""
    height, width = grays[0].shape
    found = np.empty((len(grays), len(angles), len(depths)), np.float32)
    across, down = np.cos(angles)[:, None] * (radius - depths), np.sin(angles)[:, None] * (radius - depths)
    for k, gray in enumerate(grays):
        x, y = (centers[k, 0] + across - 0.5).astype(np.float32), (centers[k, 1] + down - 0.5).astype(np.float32)
        found[k] = cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        found[k][(x < 0) | (y < 0) | (x > width - 1) | (y > height - 1)] = np.nan
    return found


def _measure_edges(grays: Sequence[Image], x: float, y: float, start: float, black: float, dark_step: float) -> Edges:
    """Measure the circle in every full image, from an approximate one of center x, y and radius `start`. The radius is
    that of all images. The center may move a little: lens and camera are not one piece.
    """
    angles = np.arange(ANGLES) * np.float64(2 * np.pi / ANGLES)
    radius, centers = float(start), np.repeat([[x, y]], len(grays), 0)
    for search in SEARCH:
        step = max(radius / 1000, 0.5)
        reach = 3 * search * radius + 2 * max(EDGE_WIDTH * radius, MIN_EDGE_PX)
        depths = np.arange(-reach, reach, step)
        levels = _profiles(grays, centers, radius, angles, depths)
        error, contrast = _edges(levels, depths, search * radius, radius, black, dark_step)
        shift, grow = _moves(error, angles, radius)
        centers, radius = centers + shift, radius + grow
        error -= shift[:, :1] * np.cos(angles) + shift[:, 1:] * np.sin(angles) + grow
        if not 0.1 * start < radius < 2 * start:
            break
    middle = np.argmin(np.abs(depths))
    visible = np.isfinite(levels[:, :, middle]).mean(0) > 0.5
    return Edges(grays, black, dark_step, radius, centers, angles, error, contrast, visible)


def _edges(
    levels: NDArray, depths: NDArray, search_px: float, radius: float, black: float, dark_step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(K, A) distance of the edges outside of the circle, px, and their contrast; NaN where there is none."""
    step = depths[1] - depths[0]
    count = max(round(max(EDGE_WIDTH * radius, MIN_EDGE_PX) / step), 1)
    above = np.maximum(levels - black, 0)
    sums = np.cumsum(np.nan_to_num(above), axis=2, dtype=np.float64)
    sums[np.isnan(levels)] = np.nan  # lines that leave the image have no edge there
    mean = (sums[:, :, count:] - sums[:, :, :-count]) / count
    outer, inner = mean[:, :, :-count], mean[:, :, count:]
    at = depths[count : count + outer.shape[2]] + step / 2
    rise = inner - outer
    contrast = rise / np.maximum(inner, 1e-6)
    score = rise / (inner + 2 * dark_step) * np.exp(-0.5 * (at / search_px) ** 2)
    score[~((rise > dark_step) & (contrast > MIN_CONTRAST))] = 0  # also where there is no number
    best = score.argmax(2)[:, :, None]
    found = np.take_along_axis(score, best, 2)[:, :, 0] > 0
    contrast = np.take_along_axis(contrast, best, 2)[:, :, 0]
    # The score prefers the outer side of an edge. The edge itself lies where the level rises most.
    near = np.clip(best + np.arange(-count, count + 1), 0, len(at) - 1)
    rises = np.nan_to_num(np.take_along_axis(rise, near, 2))
    peak = np.maximum(rises - 0.8 * rises.max(2, keepdims=True), 1e-12)
    place = (at[near] * peak).sum(2) / peak.sum(2)
    return np.where(found, -place, np.nan), np.where(found, contrast, np.nan)


def _moves(error: NDArray, angles: NDArray, radius: float) -> tuple[NDArray[np.float64], float]:
    """(K, 2) movement of each center and growth of the radius, px, that explain (K, A) errors: least squares with
    Tukey's weights. Images that show little of the border stay near the mean center.
    """
    count = len(error)
    columns = np.stack([np.cos(angles), np.sin(angles)], 1)
    shift, grow = np.zeros((count, 2)), 0.0
    known = np.isfinite(error)
    values = np.where(known, error, 0.0)
    prior = (1.0 / max(DRIFT * radius, 0.5)) ** 2
    for _ in range(8):
        left = np.where(known, error - shift @ columns.T - grow, np.nan)
        scale = max(3 * 1.48 * float(np.nanmedian(np.abs(left))) if known.any() else 0.0, 1.5)
        weights = ANGLE_WEIGHT * np.where(known, np.maximum(1 - (left / scale) ** 2, 0) ** 2, 0.0)
        # Unknowns: 2 for each image, the radius, and the mean center.
        matrix, right = np.zeros((2 * count + 3, 2 * count + 3)), np.zeros(2 * count + 3)
        for k in range(count):
            own = slice(2 * k, 2 * k + 2)
            weighted = weights[k][:, None] * columns
            matrix[own, own] = weighted.T @ columns + prior * np.eye(2)
            matrix[own, -3] = matrix[-3, own] = weighted.sum(0)
            matrix[own, -2:] = matrix[-2:, own] = -prior * np.eye(2)
            right[own] = weighted.T @ values[k]
        matrix[-3, -3], right[-3] = weights.sum() + 1e-9, (weights * values).sum()
        matrix[-2:, -2:] = (count * prior + 1e-9) * np.eye(2)
        solution = np.asarray(np.linalg.solve(matrix, right), np.float64)
        shift, grow = solution[: 2 * count].reshape(-1, 2), float(solution[-3])
    return shift, grow


def _measure_rim(edges: Edges) -> float:
    """Width of the rim, px inside of the radius: it ends at the last depth where levels are faded, or change much more
    across the border than along it. Tissue moves and its structures have any direction; a rim stays.
    """
    depths = np.arange(0.0, TISSUE[1] * edges.radius, 0.5)
    rows = (edges.profiles(depths) - edges.black)[edges.hits]
    rows = rows[np.isfinite(rows).all(1)]
    least = max(MIN_RIM * edges.radius, MIN_RIM_PX)
    tissue = depths >= TISSUE[0] * edges.radius
    normal = rows[:, tissue].mean(1)
    lit = normal > 2 * edges.step
    if lit.sum() < 20:
        return least
    share = rows[lit] / normal[lit, None]
    change = np.median(np.abs(share[:, 2:] - share[:, :-2]), axis=0)
    usual = np.median(change[tissue[1:-1]]) + 0.02
    level = np.median(share, axis=0)
    is_rim = (level < FADED) | (level > 1 / FADED)
    is_rim[1:-1] |= change > RADIAL * usual
    is_rim &= depths < MAX_RIM * edges.radius
    last = float(depths[np.flatnonzero(is_rim)[-1]] + 1) if is_rim.any() else 0.0
    return float(np.clip(last, least, MAX_RIM * edges.radius))
