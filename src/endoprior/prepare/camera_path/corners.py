"""Corners to follow, spread over the tissue, and their places in the next frame. `N` corners, px counted from 0."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...priors.specular import specular_likelihood
from .seen import PoseInput

MAX_CORNERS = 500
REFRESH = 0.8
"""New corners are detected when fewer than this share of `MAX_CORNERS` is left."""
EDGE_STEP = 0.05
"""No corners where depth changes by more than this share between neighbors: those are depth edges."""
CELLS = (8, 6)
"""The image is divided into these columns and rows; no cell holds more than twice its share of the corners."""
RETURN_PX = 1.0
"""Followed to the next frame and back, a corner returns within this distance."""


def gray_of(rgb_u8: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W) gray image."""
    return cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2GRAY)


def usable_tissue(seen: PoseInput) -> NDArray[np.bool_]:
    """(H, W) where the image shows tissue that belongs to a place: off tools, borders and highlights."""
    height, width = seen.tissue_mask.shape
    small = cv2.resize(seen.rgb_u8, (max(width // 2, 1), max(height // 2, 1)), interpolation=cv2.INTER_AREA)
    glint = (specular_likelihood(small * np.float32(1 / 255)) > 0.5).astype(np.uint8)
    glint = cv2.resize(cv2.dilate(glint, np.ones((3, 3))), (width, height), interpolation=cv2.INTER_NEAREST)
    tissue = cv2.erode(seen.tissue_mask.astype(np.uint8), np.ones((7, 7)), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return (tissue & (1 - glint)).astype(bool)


def new_corners(
    gray: NDArray[np.uint8], usable: NDArray[np.bool_], depth: NDArray[np.float32], taken: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(N, 2) corners on smooth tissue with depth, away from those `taken` (M, 2)."""
    near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    allowed = (usable & (near > 0) & (far - near < EDGE_STEP * depth)).astype(np.uint8)
    height, width = gray.shape
    apart = max(5, width // 80)
    for x, y in taken:
        cv2.circle(allowed, (round(float(x)), round(float(y))), apart, 0, -1)
    found = cv2.goodFeaturesToTrack(gray, 3 * MAX_CORNERS, 0.002, apart, mask=allowed)
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
    before: NDArray[np.uint8], now: NDArray[np.uint8], pixels: NDArray[np.float32], usable: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Follow corners (N, 2) by Lucas-Kanade flow, forward and backward: indices of those kept, and their pixels."""
    if not len(pixels):
        return np.zeros(0, np.intp), pixels
    options = {"winSize": (21, 21), "maxLevel": 4, "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)}
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, pixels[:, None], None, **options)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None, **options)
    there, back = there[:, 0], back[:, 0]
    good = (found & found_back).ravel().astype(bool) & (np.abs(back - pixels).max(1) < RETURN_PX)
    good &= sampled(usable, there) > 0
    kept = np.flatnonzero(good)
    return kept, there[kept]


def sampled(image: NDArray, pixels: NDArray) -> NDArray:
    """(N,) values at the pixels nearest to (N, 2); 0 outside the image."""
    height, width = image.shape
    at = np.round(np.nan_to_num(pixels, nan=-9, posinf=-9, neginf=-9)).astype(int)
    inside = (at >= 0).all(1) & (at[:, 0] < width) & (at[:, 1] < height)
    at = np.where(inside[:, None], at, 0)
    return np.where(inside, image[at[:, 1], at[:, 0]], 0)
