"""Finds smoke in the training frames, before the training: whether there is any, and the coefficients of each frame.

From the clearest frame on to both ends, the squared colors of each frame are fitted by those of the tissue as the
frames before show it, cell by cell, by least squares (see `model.photometric`). The result is a function of the
training frames alone, and stays fixed while training: fitted along with the tissue, smoke stays in it (docs/log.md).

`F` training frames, `h, w` size of the resized frames, `I, J` rows and columns of the grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import Frame, to_uint8
from ..model.photometric import GRID
from ..system.memory import workers

CELL_PX = 8  # side of a cell of the resized frames
SQUARE = 0.05  # usual square of a color
HELD_GAIN, HELD_VEIL = 0.1 * SQUARE, 1.0 * SQUARE
"""How strongly coefficients are held to those of the frame before, and then of a wider neighborhood, as shares of the
pixels of a cell."""
COARSE, FINE = 3.0, 0.7  # standard deviation of the neighborhood in which a coefficient is fitted, cells
MIN_GAIN, MAX_GAIN = 0.02, 16.0
FOLLOW = 0.15  # share by which a frame changes the running mean of the tissue
BRIGHT = 0.95  # color from which a pixel does not count: the sensor is saturated
CLEAR = 0.01  # mean veil up to which a frame counts as clear, about: the gains of clear frames average to 1
WINDOW_PX, CONTRAST_OFFSET = 17, 0.01  # neighborhood whose contrast is measured; light below which contrast is noise
HAZY_GRAY, HAZY_LOSS = 0.06, 0.45
"""Rise of gray, and loss of contrast, from the clearest frame on, which together only smoke explains."""


class Small(NamedTuple):
    """A frame at low resolution."""

    square: NDArray[np.float32]  # (h, w, 3) squared color
    weight: NDArray[np.float32]  # (h, w) 1 on tissue that is not saturated, else 0


def resized(frame: Frame) -> Small:
    """A frame with `CELL_PX` for each cell."""
    size = GRID[1] * CELL_PX, GRID[0] * CELL_PX
    color = cv2.resize(frame.rgb_u8, size, interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(255)
    share = cv2.resize(frame.tissue_mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return Small(np.asarray(color**2, np.float32), ((share > 0.99) & (color.max(-1) < BRIGHT)).astype(np.float32))


@dataclass(frozen=True)
class HazeStatistics:
    """What smoke changes in frames, (F,) each, smoothed over time."""

    gray: NDArray[np.float64]
    """Smallest over largest channel of the tissue, 0 to 1: smoke adds about the same light to all channels."""
    contrast: NDArray[np.float64]
    """Standard deviation over mean of the light around a pixel: smoke takes light away, and adds the same to all."""

    @property
    def clearest(self) -> int:
        """The frame of most contrast."""
        return int(self.contrast.argmax())

    @property
    def haze(self) -> NDArray[np.float64]:
        """(F,) 0 in frames like the clearest one; from 1 on, only smoke explains both what rises and what is lost."""
        first = self.clearest
        rise, loss = self.gray - self.gray[first], 1 - self.contrast / max(self.contrast[first], 1e-6)
        return np.maximum(np.minimum(rise / HAZY_GRAY, loss / HAZY_LOSS), 0)


def haze_statistics(frames: Sequence[Small]) -> HazeStatistics:
    """Measure frames, in the order of time."""
    gray, contrast = [], []
    for square, weight in frames:
        light = square.mean(-1)
        share, mean, second = (
            cv2.blur(values, (WINDOW_PX, WINDOW_PX)) for values in (weight, weight * light, weight * light**2)
        )
        mean, second = mean / (share + 1e-6), second / (share + 1e-6)
        ratio = np.sqrt(np.maximum(second - mean**2, 0)) / (mean + CONTRAST_OFFSET)
        contrast.append(float((weight * ratio).sum() / max(weight.sum(), 1e-6)))
        lowest, highest = (float((values * weight).sum()) for values in (square.min(-1), square.max(-1)))
        gray.append(np.sqrt(lowest / max(highest, 1e-6)))
    return HazeStatistics(_smoothed(gray), _smoothed(contrast))


def _smoothed(values: Sequence[float]) -> NDArray[np.float64]:
    padded = np.pad(values, 1, "edge")
    return (padded[:-2] + padded[1:-1] + padded[2:]) / 3


def smoke_needed(statistics: HazeStatistics) -> bool:
    """Whether frames show so much smoke at times that it needs a model."""
    return bool(statistics.haze.max() >= 1)


def smoke_of(frames: Sequence[Frame], wanted: str) -> NDArray[np.float32] | None:
    """(F, I, J, 2) gain and veil of training frames; None without smoke.

    Args:
        wanted: `smoke`, `none`, or `auto` to decide by the frames.
    """
    if wanted == "none":
        return None
    bytes_each = 64 * frames[0].tissue_mask.size  # of a frame while it is decoded and resized
    with ThreadPoolExecutor(workers(bytes_each)) as pool:
        small = list(pool.map(lambda k: resized(frames[k]), range(len(frames))))
    statistics = haze_statistics(small)
    return fitted_grids(small, statistics) if wanted == "smoke" or smoke_needed(statistics) else None


def fitted_grids(frames: Sequence[Small], statistics: HazeStatistics) -> NDArray[np.float32]:
    """(F, I, J, 2) gain and veil of frames, in the order of time.

    Each frame is compared with a running mean of those before it, freed of smoke. Between two frames tissue and camera
    move little, at this resolution.
    """
    neutral, first = np.zeros((*GRID, 2), np.float32), statistics.clearest
    neutral[..., 0] = 1
    grids = np.stack([neutral] * len(frames))
    for order in (range(first + 1, len(frames)), range(first - 1, -1, -1)):
        tissue, known, held = frames[first].square.copy(), frames[first].weight.copy(), neutral
        for k in order:
            target, weight = frames[k]
            held = grids[k] = fitted(tissue, target, weight * known, held)
            gain, veil = of_pixels(held, weight.shape)
            share = weight * np.where(known > 0, FOLLOW * np.minimum(gain, 1), 1)
            tissue += share[..., None] * (np.maximum(target - veil[..., None], 0) / gain[..., None] - tissue)
            known = np.maximum(known, weight)
    clear = np.exp(-grids[..., 1].mean((1, 2)) / CLEAR)
    grids[..., 0] /= np.exp(clear @ np.log(grids[..., 0]).mean((1, 2)) / clear.sum())
    smoky = np.minimum(statistics.haze, 1).astype(np.float32)[:, None, None, None]
    return np.asarray(
        smoky * grids + (1 - smoky) * neutral, np.float32
    )  # frames that look like the clearest one have none


def fitted(tissue: NDArray, target: NDArray, weight: NDArray, held: NDArray) -> NDArray[np.float32]:
    """(I, J, 2) gain and veil with which `tissue` becomes `target`, both (h, w, 3) squared colors.

    Args:
        weight: (h, w) of the pixels. held: (I, J, 2) coefficients of the frame before.
    """
    products = np.stack([np.ones_like(tissue), tissue, target, tissue**2, tissue * target], -1).mean(2)
    products *= weight[..., None]  # (h, w, 5)
    sums = products.reshape(GRID[0], CELL_PX, GRID[1], CELL_PX, 5).mean((1, 3))
    found = held
    for width in COARSE, FINE:  # cells that show little tissue get the smoke around them
        one, t, f, tt, tf = np.moveaxis(cv2.GaussianBlur(sums, (0, 0), width), -1, 0)
        a, b, c = tt + HELD_GAIN, t, one + HELD_VEIL
        p, q = tf + HELD_GAIN * found[..., 0], f + HELD_VEIL * found[..., 1]
        determinant = np.maximum(a * c - b * b, 1e-12)
        gain, veil = (c * p - b * q) / determinant, (a * q - b * p) / determinant
        gain = np.where(veil < 0, p / a, gain)  # smoke adds light
        found = np.stack([np.clip(gain, MIN_GAIN, MAX_GAIN), np.maximum(veil, 0)], -1)
    return np.asarray(found, np.float32)


def of_pixels(grid: NDArray, shape: tuple[int, ...]) -> tuple[NDArray, NDArray]:
    """Gain and veil of every pixel, `shape` (h, w) each, of coefficients (I, J, 2)."""
    gain, veil = (cv2.resize(grid[..., k], shape[::-1], interpolation=cv2.INTER_LINEAR) for k in (0, 1))
    return gain, veil


def cleared(frame: Frame, grid: NDArray) -> Frame:
    """The frame without the smoke that its coefficients (I, J, 2) say: where Gaussians start."""
    gain, veil = of_pixels(grid, frame.tissue_mask.shape)
    color = np.sqrt(np.maximum(frame.rgb**2 - veil[..., None], 0) / gain[..., None])
    return replace(frame, rgb_u8=to_uint8(color))


@dataclass(frozen=True)
class ClearedFrames(Sequence[Frame]):
    """Training frames (F) as `cleared` makes them, each when it is used."""

    frames: Sequence[Frame]
    grids: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, position: int) -> Frame:  # pyright: ignore[reportIncompatibleMethodOverride]
        return cleared(self.frames[position], self.grids[position])
