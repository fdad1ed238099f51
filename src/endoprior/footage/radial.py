"""Measure a round border along radial lines: where each sample image becomes brighter, and its circle in each image.

Shared letters: `K` sample images, `A` angles, `D` depths inside of the circle, px (negative outside).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .circle import Circle
from .dark_outline import Darkness

ANGLES = 360
SEARCH = (0.02, 0.01, 0.005)
"""Standard deviation of the search around the circle, in radii: one round each, which reaches three times as far."""
EDGE_WIDTH = 0.006
"""Length over which levels are averaged on both sides of an edge, in radii."""
LEAST_EDGE_PX = 1.5
LEAST_CONTRAST = 0.4
"""The level outside of an edge is lower by at least this share of the level inside."""
DRIFT = 0.005
"""Typical movement of the border in the image, in radii."""
SHARED = 0.125
"""Weight of one angle: neighbors have the same error."""


@dataclass(frozen=True)
class Edges:
    """The round border in every image."""

    radius: float
    centers: NDArray[np.float64]
    """(K, 2) px."""
    angles: NDArray[np.float64]
    """(A,) radians; 0 points right, pi/2 down."""
    error: NDArray[np.float64]
    """(K, A) distance of the edge from the image's circle, px, positive outside; NaN without an edge."""
    contrast: NDArray[np.float64]
    """(K, A) share 0..1 of the level inside that is lost across the edge; NaN without one."""
    visible: NDArray[np.bool_]
    """(A,) True where the circle lies in the image."""

    @property
    def tolerance_px(self) -> float:
        """Largest error of an edge that lies on the circle."""
        return max(0.005 * self.radius, 1.5)

    @property
    def hits(self) -> NDArray[np.bool_]:
        """(K, A) True where the edge lies on the circle."""
        return np.abs(np.nan_to_num(self.error, nan=np.inf)) < self.tolerance_px

    def circle(self, k: int) -> Circle:
        """The circle of one image."""
        return Circle(float(self.centers[k, 0]), float(self.centers[k, 1]), self.radius)


def profiles(
    grays: Sequence[NDArray[np.uint8]], circles: Sequence[Circle], angles: NDArray, depths: NDArray
) -> NDArray[np.float32]:
    """(K, A, D) levels along radial lines; NaN outside of the image."""
    height, width = grays[0].shape
    found = np.empty((len(grays), len(angles), len(depths)), np.float32)
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    for k, (gray, circle) in enumerate(zip(grays, circles, strict=True)):
        reach = circle.radius - depths
        x = (circle.center_x + cos * reach - 0.5).astype(np.float32)
        y = (circle.center_y + sin * reach - 0.5).astype(np.float32)
        found[k] = cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        found[k][(x < 0) | (y < 0) | (x > width - 1) | (y > height - 1)] = np.nan
    return found


def measure_edges(grays: Sequence[NDArray[np.uint8]], start: Circle, darkness: Darkness) -> Edges:
    """Measure the circle in every full image (H, W), beginning with an approximate one.

    The radius is that of all images. The center may move a little: lens and camera are not one piece.
    """
    angles = np.arange(ANGLES) * (2 * np.pi / ANGLES)
    radius = start.radius
    centers = np.repeat([[start.center_x, start.center_y]], len(grays), 0)
    for search in SEARCH:
        step = max(radius / 1000, 0.5)
        reach = 3 * search * radius + 2 * max(EDGE_WIDTH * radius, LEAST_EDGE_PX)
        depths = np.arange(-reach, reach, step)
        circles = [Circle(x, y, radius) for x, y in centers]
        levels = profiles(grays, circles, angles, depths)
        error, contrast = _edges(levels, depths, search * radius, radius, darkness)
        shift, grow = _moves(error, angles, radius)
        centers, radius = centers + shift, radius + grow
        error -= shift[:, :1] * np.cos(angles) + shift[:, 1:] * np.sin(angles) + grow
        if not 0.1 * start.radius < radius < 2 * start.radius:
            break
    middle = np.argmin(np.abs(depths))
    return Edges(radius, centers, angles, error, contrast, np.isfinite(levels[:, :, middle]).mean(0) > 0.5)


def _edges(levels: NDArray, depths: NDArray, search_px: float, radius: float, darkness: Darkness) -> tuple:
    """(K, A) distance of the edges outside of the circle, px, and their contrast; NaN where there is none."""
    step = depths[1] - depths[0]
    count = max(round(max(EDGE_WIDTH * radius, LEAST_EDGE_PX) / step), 1)
    above = np.maximum(levels - darkness.level, 0)
    sums = np.cumsum(np.nan_to_num(above), axis=2, dtype=np.float64)
    sums[np.isnan(levels)] = np.nan  # lines that leave the image have no edge there
    mean = (sums[:, :, count:] - sums[:, :, :-count]) / count
    outer, inner = mean[:, :, :-count], mean[:, :, count:]
    at = depths[count : count + outer.shape[2]] + step / 2
    rise = inner - outer
    contrast = rise / np.maximum(inner, 1e-6)
    score = rise / (inner + 2 * darkness.step) * np.exp(-0.5 * (at / search_px) ** 2)
    score[~((rise > darkness.step) & (contrast > LEAST_CONTRAST))] = 0  # also where there is no number
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
    """(K, 2) movement of each center and growth of the radius, px, that explain (K, A) errors; robust.

    Least squares with Tukey's weights. Images that show little of the border stay near the mean center.
    """
    count = len(error)
    columns = np.stack([np.cos(angles), np.sin(angles)], 1)
    shift, grow = np.zeros((count, 2)), 0.0
    known = np.isfinite(error)
    prior = (1.0 / max(DRIFT * radius, 0.5)) ** 2
    for _ in range(8):
        left = np.where(known, error - shift @ columns.T - grow, np.nan)
        scale = max(3 * 1.48 * float(np.nanmedian(np.abs(left))) if known.any() else 0.0, 1.5)
        weights = SHARED * np.where(known, np.maximum(1 - (left / scale) ** 2, 0) ** 2, 0.0)
        # Unknowns: 2 for each image, the radius, and the mean center.
        matrix, right = np.zeros((2 * count + 3, 2 * count + 3)), np.zeros(2 * count + 3)
        values = np.where(known, error, 0.0)
        for k in range(count):
            own = slice(2 * k, 2 * k + 2)
            weighted = weights[k][:, None] * columns
            matrix[own, own] = weighted.T @ columns + prior * np.eye(2)
            matrix[own, -3] = matrix[-3, own] = weighted.sum(0)
            matrix[own, -2:] = matrix[-2:, own] = -prior * np.eye(2)
            right[own] = weighted.T @ values[k]
        matrix[-3, -3], right[-3] = weights.sum() + 1e-9, (weights * values).sum()
        matrix[-2:, -2:] = (count * prior + 1e-9) * np.eye(2)
        solution = np.linalg.solve(matrix, right)
        shift, grow = solution[: 2 * count].reshape(-1, 2), float(solution[-3])
    return shift, grow
