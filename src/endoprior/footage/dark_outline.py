"""Outline of the dark regions of sample images: where a border can be, together with shadows and text.

Shared letters: `K` sample images of one clip, `H, W` image size, `P` points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import spread

WORKING_SIDE_PX = 640
"""Larger images are reduced to this: the outline needs no more, and the circle is measured in full images later."""
FEW = 9
"""Number of images that tell what black is."""
DARKEST_SHARE = 0.01
"""A border covers at least this share of the image."""
MOST_BLACK = 40
"""A border is darker than this level."""
LEAST_STEP = 4
"""Smallest difference of levels between a border and the image."""
LEAST_REGION = 0.001
"""Smaller dark regions, as a share of the image, are ignored."""
LINE_SHARE = 0.2
"""An outline with this share of the image's width in one row, or of its height in one column, is a straight border."""
Gray = NDArray[np.uint8]


@dataclass(frozen=True)
class Darkness:
    """What black means in a clip."""

    level: float
    """Median level of the darkest region, 0..255."""
    step: float
    """Levels above `level` that are not black; several standard deviations of the noise."""


def brightness(image: NDArray[np.uint8]) -> Gray:
    """(H, W) largest channel of an image (H, W, 3)."""
    red, green, blue = cv2.split(image)
    return cv2.max(cv2.max(red, green), blue)


def reduced(grays: Sequence[Gray]) -> tuple[list[Gray], float]:
    """Images with sides of at most `WORKING_SIDE_PX`, and the factor from their px to px of `grays`."""
    height, width = grays[0].shape
    factor = max(1.0, max(height, width) / WORKING_SIDE_PX)
    if factor == 1:
        return list(grays), 1.0
    size = round(width / factor), round(height / factor)
    return [cv2.resize(gray, size, interpolation=cv2.INTER_AREA) for gray in grays], width / size[0]


def find_darkness(grays: Sequence[Gray]) -> Darkness | None:
    """Level and noise of the darkest region of (H, W) images; None if it is too bright for a border."""
    some = [grays[i] for i in spread(len(grays), FEW)]
    smooth = np.stack([cv2.blur(gray, (3, 3)) for gray in some])
    typical = np.partition(smooth, (len(smooth) - 1) // 2, axis=0)[(len(smooth) - 1) // 2]
    darkest = float(np.quantile(typical, DARKEST_SHARE))
    if darkest >= MOST_BLACK:
        return None
    dark = smooth[:, typical <= darkest + LEAST_STEP]
    level = float(np.median(dark))
    noise = 1.48 * float(np.median(np.abs(dark - level)))
    return Darkness(level, float(np.clip(5 * noise, LEAST_STEP, MOST_BLACK)))


def outline_points(grays: Sequence[Gray], darkness: Darkness) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points where (H, W) images become brighter than black, px, and unit vectors to the brighter side: (P, 2) each.

    Straight borders along rows or columns are left out.
    """
    points, inward = [np.empty((0, 2))], [np.empty((0, 2))]
    for gray in grays:
        smooth = cv2.blur(gray, (3, 3))
        dark = _large(smooth <= darkness.level + darkness.step)
        edge = (cv2.dilate(dark, np.ones((3, 3), np.uint8)) > dark) & ~_lines(dark)
        edge[:2] = edge[-2:] = edge[:, :2] = edge[:, -2:] = False
        y, x = np.nonzero(edge)
        if not len(x):
            continue
        wide = cv2.GaussianBlur(gray, (0, 0), 2).astype(np.float32)
        slope = np.stack([cv2.Sobel(wide, cv2.CV_32F, *order)[y, x] for order in ((1, 0), (0, 1))], 1)
        length = np.hypot(*slope.T)
        steep = length > darkness.step
        points.append(np.stack([x, y], 1)[steep] + 0.5)
        inward.append((slope / np.maximum(length, 1e-6)[:, None])[steep].astype(np.float64))
    return np.concatenate(points), np.concatenate(inward)


def _large(dark: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(H, W) 1 on the connected regions that are not small."""
    _, regions, stats, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= LEAST_REGION * dark.size
    large[0] = False
    return large.astype(np.uint8)[regions]


def _lines(dark: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) True within 2 px of rows or columns along which a long part of the outline lies."""
    found = np.zeros(dark.shape, bool)
    for axis, lines in ((0, found), (1, found.T)):
        changes = (np.diff(dark.astype(np.int8), axis=axis) != 0).sum(1 - axis)
        for place in np.flatnonzero(changes > LINE_SHARE * dark.shape[1 - axis]):
            lines[max(place - 2, 0) : place + 4] = True
    return found
