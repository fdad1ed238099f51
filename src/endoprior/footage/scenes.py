"""Where a video is cut: the image changes at once, and no tissue of before is found again after it.

Smoke, a tool that moves, blur and a flash change the image, too, but the tissue is the same before and after.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .components import Image

THUMB_WIDTH = 64  # images that follow each other are compared at this width, px
LEAST_SPREAD = 8.0  # standard deviation of gray levels below which an image shows next to nothing
JUMP, JUMP_RATIO = 0.25, 3.0
"""Least change of the image at a cut, in standard deviations, and relative to the usual change around it."""
ALIKE = 0.88  # largest correlation with the image before, shifted as fits best; what moves a little has more
AROUND_S = 0.5  # what is around it, s


def standardized(thumb: Image) -> NDArray[np.float32]:
    """Gray values (h, w) as float32 of mean 0 and standard deviation 1, so that exposure does not matter."""
    values = thumb.astype(np.float32)
    return (values - values.mean()) / max(float(values.std()), LEAST_SPREAD)


def change(before: NDArray[np.float32], now: NDArray[np.float32]) -> float:
    """Mean difference of two thumbnails, see `standardized`; 0 where a shift explains it."""
    found = float(np.abs(now - before).mean())
    if found <= JUMP:
        return found
    rows, columns = (side // 5 for side in now.shape)
    middle = np.ascontiguousarray(before[rows : len(before) - rows, columns : before.shape[1] - columns])
    if min(middle.std(), now.std()) < 0.1:  # black or white: any two are alike
        return found
    return 0.0 if cv2.matchTemplate(now, middle, cv2.TM_CCOEFF_NORMED).max() > ALIKE else found


def jumps(seconds: NDArray[np.float64], changes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) True where an image is suddenly another one than the image before.

    Args:
        seconds: (N,) times of the images, ascending.
        changes: (N,) `change` of each thumbnail from the one before.
    """
    found = np.zeros(len(changes), bool)
    for i in np.flatnonzero(changes > JUMP):
        first, end = np.searchsorted(seconds, [seconds[i] - AROUND_S, seconds[i] + AROUND_S])
        others = np.delete(changes[first:end], i - first)
        found[i] = changes[i] > JUMP_RATIO * (np.median(others) if len(others) else 0)
    return found


def connected(count: int, links: Sequence[tuple[int, int]]) -> NDArray[np.int32]:
    """(T,) a number for each set of images that are linked, one by one, by showing the same tissue."""
    first, second = np.array(links, np.int64).reshape(-1, 2).T
    return connected_components(coo_array((np.ones(len(first)), (first, second)), (count, count)), directed=False)[1]


def breaks(count: int, links: Iterable[tuple[int, int]]) -> NDArray[np.bool_]:
    """(T,) True at images from which on no tissue of the images before is found again; the first one is False.

    Args:
        links: pairs of images, the earlier one first, that show the same tissue.
    """
    bridges = np.zeros(count + 1, np.int64)
    for before, after in links:
        bridges[before + 1] += 1
        bridges[after + 1] -= 1
    is_break = np.cumsum(bridges)[:count] == 0
    is_break[:1] = False
    return is_break
