"""Corners to follow, spread over the tissue, and their places in the next frame. `N` corners, px counted from 0."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...footage.optical_flow import follow_both_ways
from ...priors.specular import specular_likelihood
from .seen import PoseInput

MAX_CORNERS = 500
REFRESH = 0.8
"""New corners are detected when fewer than this share of `MAX_CORNERS` is left."""
EDGE_STEP = 0.05
"""No corners where depth changes by more than this share between neighbors: those are depth edges."""
CELLS = (8, 6)
"""The image is divided into these columns and rows; no cell holds more than twice its share of the corners."""
FLAT_WIDTHS, FLAT_CONTRAST = 64, 300.0
"""Shading is what is left after a blur by the image width divided by this; contrast of the rest, gray levels."""
COARSE_HALVINGS, FINE_HALVINGS = 4, 1
"""How often images are halved to follow corners: plain images, then flat ones."""
FINE_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 0.01)
FINE_PX = 2.0
"""The two results differ by less than this."""
RETURN_PX = 1.0
"""Followed to the next frame and back, a corner returns within this distance."""


@dataclass(frozen=True)
class Gray:
    """A frame as corners are followed in it."""

    plain: NDArray[np.uint8]
    """(H, W) brightness: finds large motion."""
    flat: NDArray[np.uint8]
    """(H, W) without shading: the light moves with the camera, and what it paints must not count as tissue."""


def gray_of(rgb_u8: NDArray[np.uint8]) -> Gray:
    """The gray images of (H, W, 3)."""
    plain = cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2GRAY)
    bright = np.log(plain.astype(np.float32) + 8)
    bright -= cv2.GaussianBlur(bright, (0, 0), max(plain.shape[1] / FLAT_WIDTHS, 2.0))
    return Gray(plain, np.clip(bright * FLAT_CONTRAST + 128, 0, 255).astype(np.uint8))


def usable_tissue(seen: PoseInput) -> NDArray[np.bool_]:
    """(H, W) where the image shows tissue that belongs to a place: off tools, borders and highlights."""
    height, width = seen.tissue_mask.shape
    small = cv2.resize(seen.rgb_u8, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
    glint = (specular_likelihood(small * np.float32(1 / 255)) > 0.5).astype(np.uint8)
    glint = cv2.resize(cv2.dilate(glint, np.ones((3, 3))), (width, height), interpolation=cv2.INTER_NEAREST)
    tissue = cv2.erode(
        seen.tissue_mask.astype(np.uint8), np.ones((7, 7)), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    return (tissue & (1 - glint)).astype(bool)


def new_corners(
    gray: Gray, usable: NDArray[np.bool_], depth: NDArray[np.float32], taken: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(N, 2) corners on smooth tissue with depth, away from those `taken` (M, 2)."""
    near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    allowed = (usable & (near > 0) & (far - near < EDGE_STEP * depth)).astype(np.uint8)
    height, width = depth.shape
    apart = max(5, width // 80)
    for x, y in taken:
        cv2.circle(allowed, (round(float(x)), round(float(y))), apart, 0, -1)
    found = cv2.goodFeaturesToTrack(gray.flat, 3 * MAX_CORNERS, 0.002, apart, mask=allowed)
    if found is None:
        return np.zeros((0, 2), np.float32)
    found = found.reshape(-1, 2)  # strongest first
    cell, before = _cells(found, width, height), np.bincount(_cells(taken, width, height), minlength=np.prod(CELLS))
    most = 2 * MAX_CORNERS // int(np.prod(CELLS))
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(np.prod(CELLS)))
    rank = np.empty(len(found), int)
    rank[order] = np.arange(len(found)) - first[cell[order]]
    return found[rank + before[cell] < most][: max(MAX_CORNERS - len(taken), 0)]


def _cells(pixels: NDArray, width: int, height: int) -> NDArray[np.intp]:
    column = np.clip((pixels[:, 0] * CELLS[0] / width).astype(int), 0, CELLS[0] - 1)
    return np.clip((pixels[:, 1] * CELLS[1] / height).astype(int), 0, CELLS[1] - 1) * CELLS[0] + column


def followed(
    before: Gray, now: Gray, pixels: NDArray[np.float32], usable: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Follow corners (N, 2) by Lucas-Kanade flow, forward and backward: indices of those kept, and their pixels."""
    if not len(pixels):
        return np.zeros(0, np.intp), pixels
    near, good = follow_both_ways(before.plain, now.plain, pixels, RETURN_PX, halvings=COARSE_HALVINGS)
    there, still_good = follow_both_ways(
        before.flat, now.flat, pixels, RETURN_PX, halvings=FINE_HALVINGS, guess=near, criteria=FINE_CRITERIA
    )
    good &= still_good & (np.abs(there - near).max(1) < FINE_PX) & (sampled(usable, there) > 0)
    kept = np.flatnonzero(good)
    return kept, there[kept]


def sampled(image: NDArray, pixels: NDArray) -> NDArray:
    """(N,) values at the pixels nearest to (N, 2); 0 outside the image."""
    height, width = image.shape
    at = np.round(np.nan_to_num(pixels, nan=-9, posinf=-9, neginf=-9)).astype(int)
    inside = (at >= 0).all(1) & (at[:, 0] < width) & (at[:, 1] < height)
    at = np.where(inside[:, None], at, 0)
    return np.where(inside, image[at[:, 1], at[:, 0]], 0)
