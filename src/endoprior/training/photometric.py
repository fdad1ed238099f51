"""Finds what lies between tissue and frames before the training: exposure, smoke, or nothing worth a model.

Frame by frame, from the clearest one to both ends, coefficients are solved for: the least-squares fit of the frame's
squared colors by those of the tissue as the frames before show it, cell by cell. They are functions of the training
frames alone and stay fixed while training: fitted along with the tissue, they would end where it started, in haze.

`F` training frames, `h, w` size of the resized image, `I, J` rows and columns of the grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.types import Frame
from ..model.photometric import GRIDS, LEAST, MOST, Kind, neutral

WORK_SIZE = (192, 144)  # width and height at which frames are compared, px: 8 x 8 for each cell of the finest grid
SQUARE = 0.05  # usual square of a color
HELD_GAIN, HELD_VEIL = 0.1 * SQUARE, 1.0 * SQUARE
"""How strongly coefficients are held to those of the frame before, or of a wider neighborhood, as shares of a cell's
pixels."""
COARSE, FINE = 3.0, 0.7  # standard deviation of the neighborhood in which a coefficient is fitted, cells
FOLLOW = 0.15  # share by which a frame changes the running mean of the tissue
BRIGHT = 0.95  # color from which a pixel does not count: the sensor is saturated
CLEAR = 0.01  # mean veil up to which a frame counts as clear, about: the gains of clear frames average to 1
WINDOW, DARK = 17, 0.01  # side of a neighborhood whose contrast is measured, px; light below which contrast is noise
HAZY_GRAY, HAZY_LOSS = 0.06, 0.45
"""Rise of gray, and loss of contrast, from the clearest frame on, which together only smoke explains."""


class Small(NamedTuple):
    """A frame at low resolution."""

    square: NDArray[np.float32]  # (h, w, 3) squared color
    weight: NDArray[np.float32]  # (h, w) 1 on tissue that is not saturated, else 0


def resized(frame: Frame) -> Small:
    """A frame at `WORK_SIZE`."""
    color = cv2.resize(frame.rgb_u8, WORK_SIZE, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    share = cv2.resize(frame.tissue_mask.astype(np.float32), WORK_SIZE, interpolation=cv2.INTER_AREA)
    return Small(color**2, ((share > 0.99) & (color.max(-1) < BRIGHT)).astype(np.float32))


@dataclass(frozen=True)
class Looks:
    """How frames look that smoke may veil, (F,) each, smoothed over time."""

    gray: NDArray[np.float64]
    """Smallest over largest channel of the tissue, 0 to 1: smoke adds about the same light to all channels."""
    contrast: NDArray[np.float64]
    """Standard deviation over mean of the light in a neighborhood: smoke takes light away, and adds the same to all."""

    @property
    def clearest(self) -> int:
        """The frame with most contrast."""
        return int(self.contrast.argmax())

    @property
    def haze(self) -> NDArray[np.float64]:
        """(F,) 0 for a frame like the clearest one; from 1 on, both the rise of gray and the loss of contrast mean smoke."""
        first = self.clearest
        rise, loss = self.gray - self.gray[first], 1 - self.contrast / max(self.contrast[first], 1e-6)
        return np.maximum(np.minimum(rise / HAZY_GRAY, loss / HAZY_LOSS), 0)


def looks_of(frames: Sequence[Small]) -> Looks:
    """What tells smoke."""
    gray, contrast = [], []
    for square, weight in frames:
        total = max(float(weight.sum()), 1e-6)
        light = square.mean(-1)
        share, mean, second = (cv2.blur(values, (WINDOW, WINDOW)) for values in (weight, weight * light, weight * light**2))
        mean, second = mean / (share + 1e-6), second / (share + 1e-6)
        ratio = np.sqrt(np.maximum(second - mean**2, 0)) / (mean + DARK)
        contrast.append(float((weight * ratio).sum()) / total)
        gray.append(np.sqrt((square.min(-1) * weight).sum() / max((square.max(-1) * weight).sum(), 1e-6)))
    return Looks(_smoothed(gray), _smoothed(contrast))


def _smoothed(values: Sequence[float]) -> NDArray[np.float64]:
    padded = np.pad(values, 1, "edge")
    return (padded[:-2] + padded[1:-1] + padded[2:]) / 3


def needed(looks: Looks) -> Kind:
    """The photometric model that frames need."""
    return "smoke" if looks.haze.max() >= 1 else "none"


def photometric_grids(frames: Sequence[Frame], wanted: str) -> NDArray[np.float32] | None:
    """(F, I, J, 2, 3) coefficients of training frames; None where nothing lies between them and the tissue.

    Args:
        wanted: a kind, or `auto` for the one that the frames need.
    """
    if wanted == "none":
        return None
    small = [resized(frame) for frame in frames]
    kind = wanted
    if wanted == "auto":
        kind = needed(looks_of(small))
    return None if kind == "none" else fitted_grids(small, kind)


def fitted_grids(frames: Sequence[Small], kind: str) -> NDArray[np.float32]:
    """(F, I, J, 2, 3) coefficients of frames, in the order of time.

    Each frame is compared with a running mean of those before it, freed of what lies before the tissue. Between two
    frames tissue and camera move little, at this resolution.
    """
    looks, grids = looks_of(frames), neutral(len(frames), kind).numpy()
    first = looks.clearest
    for order in (range(first + 1, len(frames)), range(first - 1, -1, -1)):
        tissue, known, held = frames[first].square.copy(), frames[first].weight.copy(), grids[first]
        for k in order:
            target, weight = frames[k]
            held = grids[k] = fitted(tissue, target, weight * known, held, kind)
            gain, veil = spread(held, weight.shape)
            clear = np.maximum(target - veil, 0) / gain
            share = weight * np.where(known > 0, FOLLOW * np.minimum(gain.mean(-1), 1), 1)
            tissue += share[..., None] * (clear - tissue)
            known = np.maximum(known, weight)
    normalize(grids)
    if kind == "smoke":  # frames that look like the clearest one have none
        smoky = np.minimum(looks.haze, 1)[:, None, None, None, None].astype(np.float32)
        grids = smoky * grids + (1 - smoky) * neutral(len(frames), kind).numpy()
    return grids


def fitted(tissue: NDArray, target: NDArray, weight: NDArray, held: NDArray, kind: str) -> NDArray[np.float32]:
    """(I, J, 2, 3) coefficients with which `tissue` becomes `target`, both (h, w, 3) squared colors.

    Args:
        weight: (h, w) of the pixels. held: (I, J, 2, 3) coefficients that those of cells with few pixels tend to.
    """
    rows, columns = held.shape[:2]
    products = np.stack([np.ones_like(tissue), tissue, target, tissue**2, tissue * target], -1)
    products *= weight[..., None, None]  # (h, w, 3, 5)
    h, w = weight.shape
    sums = products.reshape(rows, h // rows, columns, w // columns, 3, 5).mean((1, 3))
    if kind == "exposure":
        *_, tt, tf = np.moveaxis(sums, -1, 0)
        gain = (tf + HELD_GAIN * SQUARE * held[:, :, 0]) / (tt + HELD_GAIN * SQUARE)
        return np.stack([np.clip(gain, LEAST, MOST), np.zeros_like(gain)], 2).astype(np.float32)
    for width in COARSE, FINE:  # cells that show little tissue get what lies before the tissue around them
        held = _gray_fit(cv2.GaussianBlur(sums.mean(2), (0, 0), width), held)
    return held


def _gray_fit(sums: NDArray, held: NDArray) -> NDArray[np.float32]:
    """`fitted` of smoke: channels share their coefficients. Args: sums: (I, J, 5) means of 1, t, f, t^2 and t f."""
    one, t, f, tt, tf = np.moveaxis(sums, -1, 0)
    a, b, c = tt + HELD_GAIN, t, one + HELD_VEIL
    p, q = tf + HELD_GAIN * held[:, :, 0, 0], f + HELD_VEIL * held[:, :, 1, 0]
    determinant = np.maximum(a * c - b * b, 1e-12)
    gain, veil = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    gain = np.where(veil < 0, p / a, gain)  # no veil takes light away
    gain, veil = np.clip(gain, LEAST, MOST), np.maximum(veil, 0)
    return np.repeat(np.stack([gain, veil], 2)[..., None], 3, -1).astype(np.float32)


def normalize(grids: NDArray[np.float32]) -> None:
    """Scale gains (F, I, J, 2, 3) in place, so that those of clear frames have the geometric mean 1 in each channel."""
    clear = np.exp(-grids[:, :, :, 1].mean((1, 2, 3)) / CLEAR)
    logs = np.log(grids[:, :, :, 0]).mean((1, 2))  # (F, 3)
    grids[:, :, :, 0] /= np.exp((clear @ logs) / clear.sum())


def spread(grid: NDArray, shape: tuple[int, ...]) -> tuple[NDArray, NDArray]:
    """Gain and veil of every pixel, (h, w, 3) each, of coefficients (I, J, 2, 3); `shape` is (h, w)."""
    size = shape[1], shape[0]
    gain, veil = (cv2.resize(grid[:, :, k], size, interpolation=cv2.INTER_LINEAR) for k in (0, 1))
    return gain.reshape(*shape, 3), veil.reshape(*shape, 3)


def cleared(frame: Frame, grid: NDArray) -> Frame:
    """The frame without what its coefficients (I, J, 2, 3) say lies before the tissue."""
    gain, veil = spread(grid, frame.tissue_mask.shape)
    color = np.sqrt(np.maximum(frame.rgb**2 - veil, 0) / gain)
    return replace(frame, rgb_u8=(np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8))


def cleared_frames(frames: Sequence[Frame], grids: NDArray) -> Sequence[Frame]:
    """`cleared` of training frames (F), each when it is used."""
    return _Cleared(frames, grids)


@dataclass(frozen=True)
class _Cleared(Sequence[Frame]):
    frames: Sequence[Frame]
    grids: NDArray

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, position):  # pyright: ignore[reportIncompatibleMethodOverride]
        if isinstance(position, slice):
            return _Cleared(self.frames[position], self.grids[position])
        return cleared(self.frames[position], self.grids[position])
