"""First guess of a round border: the circle that most of the outline of dark regions lies on. `P` outline points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import evenly_spaced
from .components import Image, Mask, dilated, large_regions, square

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


@dataclass(frozen=True)
class Darkness:
    """What black means in a clip."""

    level: float  # Median level of the darkest region, 0..255
    step: float  # Levels above `level` that are not black; several standard deviations of the noise


def brightness(image: Image) -> Image:
    """(H, W) largest channel of an image (H, W, 3)."""
    red, green, blue = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(red, green), blue), np.uint8)


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
