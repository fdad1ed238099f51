"""Detect the round border of an endoscope image, though glare or dark tissue touches it and it moves a little.

Outlines of the dark regions of all sample images vote for one circle. It is then measured along radial lines in every
image, and rejected unless the images agree: the edge is sharp, on the circle, bent as the circle is, and its outside is
dark. `K` sample images of one clip, (H, W); `P` outline points; `A` angles; `D` depths inside of the circle, px.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import evenly_spaced
from .image_operations import Image, Mask, dilated, large_regions, largest_channel, square

WORKING_SIDE_PX = 640  # Larger images are reduced for the first guess; the circle is measured in full images later
FEW = 9  # Number of images that tell what black is
DARKEST_SHARE = 0.01  # A border covers at least this share of the image
MAX_BLACK = 40  # A border is darker than this level
MIN_BORDER_STEP = 4  # Smallest difference of levels between a border and the image
MIN_REGION = 0.001  # Smaller dark regions, as a share of the image, are ignored
LINE_SHARE = 0.2
"""An outline with this share of the image's width in one row, or of its height in one column, is a straight border."""
HYPOTHESES = 6000  # Number of circles through three random points
SCORED = 300  # Number of plausible ones to compare with all points
MAX_COMPARED_POINTS = 1500  # Number of random points used for the comparison
TOLERANCE = 0.012  # Distance from the circle, in radii, beyond which a point does not count
FACING = 0.9  # Least cosine between the direction to the center and that in which the image becomes brighter
UNMEASURED_RIM = 0.025  # Share of the radius that is left out of a circle whose rim was not measured
Points = NDArray[np.float64]

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
class Circle:
    """The round border of the endoscope image, px; the center of the top-left pixel is (0.5, 0.5)."""

    center_x: float
    center_y: float
    radius: float
    rim_px: float | None = None
    """Width inside of the radius that shows no tissue in every image: lit or blurred rim, and movement of the border.
    None: not measured."""
    agreement: float = 1.0
    """Share 0..1 of the visible circle on which the images show a border; dark parts do not count."""

    @property
    def margin_px(self) -> float:
        """Width inside of the radius to leave out, px."""
        return UNMEASURED_RIM * self.radius if self.rim_px is None else self.rim_px

    def mask(self, width: int, height: int, margin_px: float = 0.0) -> Mask:
        """(H, W) True inside the circle with its radius reduced by `margin_px`."""
        x = np.arange(width) + 0.5 - self.center_x
        y = np.arange(height)[:, None] + 0.5 - self.center_y
        return x * x + y * y < max(self.radius - margin_px, 0.0) ** 2


def find_circle(images: Sequence[Image]) -> Circle | None:
    """Detect a round border, also one of which only arcs are visible, in K images (H, W, 3) of one size. Few images of
    a short time are enough if nothing hides the border in all of them. Vignetting, shadows, cut corners and black bars
    are no round border.
    """
    grays = [largest_channel(image) for image in images]
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


@dataclass(frozen=True)
class Darkness:
    """What black means in a clip."""

    level: float  # Median level of the darkest region, 0..255
    step: float  # Levels above `level` that are not black; several standard deviations of the noise


def blurred(gray: Image) -> Image:
    """(H, W) mean over 3x3 px."""
    return np.asarray(cv2.blur(gray, (3, 3)), np.uint8)


def reduced(grays: Sequence[Image]) -> tuple[list[Image], float]:
    """Images with sides of at most `WORKING_SIDE_PX`, and the factor from their px to px of `grays`."""
    height, width = grays[0].shape
    factor = max(1.0, max(height, width) / WORKING_SIDE_PX)
    if factor == 1:
        return list(grays), 1.0
    size = round(width / factor), round(height / factor)
    small = [np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8) for gray in grays]
    return small, width / size[0]


def find_darkness(grays: Sequence[Image]) -> Darkness | None:
    """Level and noise of the darkest region of (H, W) images; None if it is too bright for a border."""
    smooth = np.stack([blurred(grays[i]) for i in evenly_spaced(len(grays), FEW)])
    typical = np.partition(smooth, (len(smooth) - 1) // 2, axis=0)[(len(smooth) - 1) // 2]
    darkest = float(np.quantile(typical, DARKEST_SHARE))
    if darkest >= MAX_BLACK:
        return None
    dark = smooth[:, typical <= darkest + MIN_BORDER_STEP]
    level = float(np.median(dark))
    noise = 1.48 * float(np.median(np.abs(dark - level)))
    return Darkness(level, float(np.clip(5 * noise, MIN_BORDER_STEP, MAX_BLACK)))


def outline_points(grays: Sequence[Image], darkness: Darkness) -> tuple[Points, Points]:
    """(P, 2) points where images become brighter than black, px, and unit vectors inwards; no straight borders."""
    points: list[Points] = [np.empty((0, 2))]
    inward: list[Points] = [np.empty((0, 2))]
    for gray in grays:
        dark = large_regions(blurred(gray) <= darkness.level + darkness.step, MIN_REGION * gray.size, 4)
        edge = dilated(dark, square(1)) & ~dark & ~_lines(dark)
        edge[:2] = edge[-2:] = edge[:, :2] = edge[:, -2:] = False
        y, x = np.nonzero(edge)
        if not len(x):
            continue
        wide = cv2.GaussianBlur(gray, (0, 0), 2).astype(np.float32)
        slope = np.stack([cv2.Sobel(wide, cv2.CV_32F, *order)[y, x] for order in ((1, 0), (0, 1))], 1)
        length = np.hypot(*slope.T)
        steep = length > darkness.step
        points.append(np.stack([x, y], 1)[steep] + np.float64(0.5))
        inward.append((slope / np.maximum(length, 1e-6)[:, None])[steep].astype(np.float64))
    return np.concatenate(points), np.concatenate(inward)


def _lines(dark: Mask) -> Mask:
    """(H, W) True within 2 px of rows or columns along which a long part of the outline lies."""
    found = np.zeros(dark.shape, bool)
    for axis, lines in ((0, found), (1, found.T)):
        changes = np.diff(dark, axis=axis).sum(1 - axis)
        for place in np.flatnonzero(changes > LINE_SHARE * dark.shape[1 - axis]):
            lines[max(place - 2, 0) : place + 4] = True
    return found


def likely_circle(points: Points, inward: Points, width: int, height: int) -> Points | None:
    """(3,) center and radius of the circle that most points lie on: random sample consensus, then a robust fit."""
    if len(points) < 20:
        return None
    rng = np.random.default_rng(0)
    triples = rng.integers(0, len(points), (HYPOTHESES, 3))
    circles = _circles_through(points[triples])
    x, y, radius = circles.T
    with np.errstate(invalid="ignore"):
        plausible = (radius > 0.25 * min(width, height)) & (radius < np.hypot(width, height))
        plausible &= (np.abs(x - width / 2) < 0.5 * width) & (np.abs(y - height / 2) < 0.5 * height)
        facing = ((circles[:, None, :2] - points[triples]) * inward[triples]).sum(-1) > FACING * radius[:, None]
    circles = circles[plausible & facing.all(1)][:SCORED]
    if not len(circles):
        return None
    chosen = rng.permutation(len(points))[:MAX_COMPARED_POINTS]
    best = circles[int(np.argmax([_weights(c, points[chosen], inward[chosen]).sum() for c in circles]))]
    for _ in range(5):
        weights = _weights(best, points, inward)
        if np.count_nonzero(weights) < 10:
            return None
        best = fit_circle(points, weights)
    return best if np.isfinite(best).all() else None


def fit_circle(points: Points, weights: NDArray[np.float64]) -> Points:
    """Center x, y and radius of the circle through (P, 2) points, by weighted linear least squares on x^2 + y^2."""
    middle = points.mean(0)
    moved = points - middle
    root = np.sqrt(weights)[:, None]
    a = np.c_[2 * moved, np.ones(len(moved))]
    x, y, c = np.linalg.lstsq(root * a, root[:, 0] * (moved**2).sum(1), rcond=None)[0]
    return np.array([x + middle[0], y + middle[1], np.sqrt(max(c + x * x + y * y, 0.0))])


def _circles_through(triples: Points) -> Points:
    """(N, 3) center and radius of the circles through (N, 3, 2) points; not finite for three points on a line."""
    origin = triples[:, 0]
    b, c = triples[:, 1] - origin, triples[:, 2] - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        det = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
        bb, cc = (b**2).sum(1), (c**2).sum(1)
        x, y = (c[:, 1] * bb - b[:, 1] * cc) / det, (b[:, 0] * cc - c[:, 0] * bb) / det
        return np.c_[x + origin[:, 0], y + origin[:, 1], np.hypot(x, y)]


def _weights(circle: Points, points: Points, inward: Points) -> NDArray[np.float64]:
    """(P,) 1 on the circle, falling to 0 at its tolerance; 0 where the image does not become brighter inwards."""
    to_center = circle[:2] - points
    distance = np.hypot(*to_center.T)
    off = (distance - circle[2]) / (TOLERANCE * circle[2])
    facing = (to_center * inward).sum(1) > FACING * distance
    return np.where(facing, np.maximum(1 - off * off, 0) ** 2, 0.0)


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
