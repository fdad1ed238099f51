"""Smooth random fields and curves, from which tissue, metal and light are painted."""

from __future__ import annotations

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.random import Generator

Field = MatLike
"""An array of floats as OpenCV takes and gives it: float32, but for sums with wider numbers on the way."""


def smooth_field(rng: Generator, size: tuple[int, int], spot_px: float) -> Field:
    """(h, w) noise of mean 0 and standard deviation of about 1, with spots of that size."""
    return _enlarged(rng, _cells(rng, size, spot_px), size, spot_px)


def fractal_field(rng: Generator, size: tuple[int, int], spot_px: float, octaves: int, gain: float = 0.5) -> Field:
    """(h, w) sum of such noise, each octave half as coarse and `gain` times as strong."""
    total, spot = _cells(rng, size, spot_px), spot_px
    for k in range(1, octaves):
        if spot < 3:
            break
        spot /= 2
        total = cv2.resize(total, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        total += np.float32(gain**k) * rng.standard_normal(total.shape, np.float32)
    return _enlarged(rng, total, size, spot)


def _cells(rng: Generator, size: tuple[int, int], spot_px: float) -> Field:
    return rng.standard_normal(tuple(int(n / spot_px) + 4 for n in size), np.float32)


def _enlarged(rng: Generator, cells: Field, size: tuple[int, int], spot_px: float) -> Field:
    """(h, w) a part of `cells`, whose cells are `spot_px` wide: smooth in steps of a quarter of a cell, then linear."""
    h, w = size
    if spot_px > 8:
        cells, spot_px = cv2.resize(cells, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC), spot_px / 4
    spot_px = max(spot_px, h / (cells.shape[0] - 1), w / (cells.shape[1] - 1))
    y, x = (rng.uniform(0, m - 1 - n / spot_px) for n, m in zip(size, cells.shape, strict=True))
    shift = np.array([[1 / spot_px, 0, x], [0, 1 / spot_px, y]], np.float32)
    return cv2.warpAffine(
        cells, shift, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )


def ridges(field: Field, width: float) -> Field:
    """(h, w) in [0, 1]: 1 along the zero lines of a field, 0 where it exceeds `width`: vessels, folds, threads."""
    return np.clip(1 - np.abs(field) / np.float32(width), 0, 1)


def random_curve(rng: Generator, knots: int, at: Field) -> Field:
    """Values in [0, 1] at the positions `at` (any shape, in [0, 1]) of a smooth random curve through `knots` values."""
    values = rng.uniform(0, 1, knots).astype(np.float32)
    position = np.clip(at, 0, 1) * (knots - 1)
    left = np.minimum(position.astype(np.int32), knots - 2)
    t = position - left
    t = t * t * (3 - 2 * t)
    return values[left] * (1 - t) + values[left + 1] * t


def log_uniform(rng: Generator, low: float, high: float) -> float:
    """A number between `low` and `high`, even in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
