"""The inverse depth of a frame: a plane sweep at low resolution, then two finer searches around what it found.

Planes are even in inverse depth w. A pixel is compared with its partners by the zero-mean normalized correlation of a
window, which bears changes of light; of the partners the better half counts, because the others may not see the place
(Kang et al. 2001). In the finer searches the window follows the surface that is known already.

The sweep takes the surface that agrees with the costs and with its neighborhood (semi-global matching, Hirschmueller
2008). Along each of eight directions r, the cost of plane d at pixel p is

    L_r(p, d) = C(p, d) + min(L_r(q, d), L_r(q, d - 1) + P1, L_r(q, d + 1) + P1, min_k L_r(q, k) + P2) - min_k L_r(q, k)

with q the pixel before p; the sum over all directions is the cost of the plane.

The sums over a window slide: down the columns, then along the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..compute.simd import REORDERED
from .camera_path.views import HighPassImage, Warp, matrix_at, scaled_size

COARSE_WIDTH, FINE_WIDTH = 128, 256  # px
PLANES = 48
NEAREST, FARTHEST = 0.25, 3.5  # depth of the first and the last plane, as a multiple of the clip's middle distance
COARSE_WINDOW_PX, FINE_WINDOW_PX = 7, 9
STEP_COST, JUMP_COST = 0.1, 0.6  # of 1 - correlation
FINER = (1 / 3, 1 / 9)  # steps of the finer searches, as shares of that between two planes
AROUND = 3  # ... and their number on each side
SMOOTH_PX = 1.5  # standard deviation by which the correlations of a finer search are smoothed
DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
NOISE = 2e-4  # variance of the detail that is noise
COVERED = 0.6  # least share of a window that both frames show
_SUMS = 6  # of weight, both details, both squares, their product
_NEAR, _ONE = np.float32(1e-3), np.float32(1)


@dataclass(frozen=True)
class Shot:
    """A frame and where its camera is."""

    view: HighPassImage  # at the fine size
    pose: NDArray[np.float64]  # (4, 4) world to camera


@dataclass(frozen=True)
class Sweep:
    """What all frames of a clip have in common."""

    size: tuple[int, int]  # (w, h) of the fine views, px
    matrix: NDArray[np.float64]  # (3, 3) K at that size, px; the left-most pixel is centered at 0
    planes: NDArray[np.float32]  # (D,) inverse depths, ascending

    @classmethod
    def of(cls, matrix: NDArray[np.float64], size: tuple[int, int], distance: float) -> Sweep:
        """For frames of `size` (W, H) whose tissue is `distance` away. Args: matrix: K of the frames, centered at 0."""
        small = scaled_size(size, FINE_WIDTH)
        planes = np.linspace(1 / (FARTHEST * distance), 1 / (NEAREST * distance), PLANES, dtype=np.float32)
        return cls(small, matrix_at(matrix, size, small), planes)

    def inverse_depth(self, shot: Shot, partners: Sequence[Shot]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(h, w) inverse depth of a frame, and the correlation with its partners, -1 to 1.

        At the ends of the planes it is 0: what is burned into the image does not move, as if it were infinitely far.
        """
        coarse = scaled_size(self.size, COARSE_WIDTH)
        found = self._planes(shot, partners, coarse)
        found = cv2.resize(cv2.medianBlur(found, 5), self.size, interpolation=cv2.INTER_LINEAR)
        warps = [Warp.between(self.matrix, shot.pose, other.pose, self.size) for other in partners]
        views = [other.view for other in partners]
        step, score = float(self.planes[1] - self.planes[0]), np.zeros_like(found)
        for share in FINER:
            around = [
                correlation(shot.view, views, warps, found + np.float32(k * share * step), FINE_WINDOW_PX)
                for k in range(-AROUND, AROUND + 1)
            ]
            scores = np.stack([cv2.GaussianBlur(each, (0, 0), SMOOTH_PX) for each in around]).astype(np.float32)
            place, score = peak(scores)
            found = cv2.medianBlur(found + np.float32(share * step) * (place - AROUND), 5)
        score[(found <= self.planes[1]) | (found >= self.planes[-2])] = 0
        return np.clip(found, self.planes[0], self.planes[-1]).astype(np.float32), score.astype(np.float32)

    def _planes(self, shot: Shot, partners: Sequence[Shot], size: tuple[int, int]) -> NDArray[np.float32]:
        """(h, w) inverse depth at the coarse size, by all planes."""
        matrix = matrix_at(self.matrix, self.size, size)
        warps = [Warp.between(matrix, shot.pose, other.pose, size) for other in partners]
        here, views = shot.view.resized(size), [other.view.resized(size) for other in partners]
        costs = np.empty((size[1], size[0], len(self.planes)), np.float32)
        for d, inverse in enumerate(self.planes):
            costs[..., d] = 1 - correlation(here, views, warps, inverse, COARSE_WINDOW_PX)
        place, _ = peak(np.ascontiguousarray(-aggregated(costs, STEP_COST, JUMP_COST).transpose(2, 0, 1)))
        return np.interp(place, np.arange(len(self.planes)), self.planes).astype(np.float32)


def peak(scores: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) place of the largest of scores (D, h, w), to a fraction by a parabola, and its score."""
    best = scores.argmax(0)[None]
    middle = np.clip(best, 1, len(scores) - 2)
    low, score, high = (np.take_along_axis(scores, middle + k, 0)[0] for k in (-1, 0, 1))
    bend = low - 2 * score + high
    shift = np.divide(0.5 * (low - high), bend, out=np.zeros_like(bend), where=np.abs(bend) > 1e-6)
    place = np.where(best == middle, best + np.clip(shift, -0.5, 0.5), best)[0]
    return place.astype(np.float32), np.take_along_axis(scores, best, 0)[0]


def aggregated(costs: NDArray[np.float32], step: float, jump: float) -> NDArray[np.float32]:
    """(h, w, D) mean over the directions of the aggregated costs.

    Args:
        costs: (h, w, D) of each pixel and plane.
        step, jump: P1 and P2, the cost of a change by one plane, and of any other one.
    """
    total, path = np.zeros_like(costs), np.empty_like(costs)
    for dy, dx in DIRECTIONS:
        _add_direction(costs, dy, dx, np.float32(step), np.float32(jump), path, total)
    total /= np.float32(len(DIRECTIONS))
    return total


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _add_direction(costs, dy, dx, step, jump, path, total):
    # path (h, w, D) is overwritten by L_r; total (h, w, D) gets it added.
    height, width, planes = costs.shape
    for row in range(height):
        y = row if dy >= 0 else height - 1 - row
        for column in range(width):
            x = column if dx >= 0 else width - 1 - column
            py, px = y - dy, x - dx
            here, cost = path[y, x], costs[y, x]
            if py < 0 or py >= height or px < 0 or px >= width:
                for d in range(planes):
                    here[d] = cost[d]
            else:
                before = path[py, px]
                least = before[0]
                for d in range(1, planes):
                    least = min(least, before[d])
                for d in range(planes):
                    best = min(before[d], least + jump)
                    if d > 0:
                        best = min(best, before[d - 1] + step)
                    if d < planes - 1:
                        best = min(best, before[d + 1] + step)
                    here[d] = cost[d] + best - least
            for d in range(planes):
                total[y, x, d] += here[d]


def correlation(
    view: HighPassImage,
    partners: Sequence[HighPassImage],
    warps: Sequence[Warp],
    inverse: NDArray[np.float32] | np.float32,
    window_px: int,
) -> NDArray[np.float32]:
    """(h, w) mean correlation with the better half of the partners, -1 to 1; -1 with one that does not see the place.

    Args:
        warps: to each partner. inverse: (h, w) inverse depth, or one for all pixels. window_px: odd.
    """
    depths = np.broadcast_to(np.asarray(inverse, np.float32), view.detail.shape)
    scores = np.empty((len(partners), *view.detail.shape), np.float32)
    for score, other, warp in zip(scores, partners, warps, strict=True):
        _correlate(
            view.detail, view.usable, other.detail, other.usable, warp.a, warp.b, depths, window_px // 2, score
        )  # fmt: skip
    out = np.empty_like(view.detail)
    _mean_of_better_half(scores, out)
    return out


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _correlate(detail1, usable1, detail2, usable2, a, b, inverse, half, out):
    # One pair; writes out (h, w).
    height, width = out.shape
    warped, weight = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for y in range(height):
        _warp_row(detail2, usable2, a[:, y], b, inverse[y], warped[y], weight[y])
        for x in range(width):
            weight[y, x] *= usable1[y, x]
    columns = np.zeros((_SUMS, width), np.float32)
    area = np.float32((2 * half + 1) ** 2)
    for y in range(height + half):
        if y < height:
            _add_row(detail1[y], warped[y], weight[y], np.float32(1), columns)
        if y > 2 * half:
            gone = y - 2 * half - 1
            _add_row(detail1[gone], warped[gone], weight[gone], np.float32(-1), columns)
        if y >= half:
            _slide(columns, half, area, out[y - half])


@njit(cache=True, nogil=True, fastmath=REORDERED, inline="always")
def _warp_row(detail, usable, a, b, inverse, to_detail, to_usable):
    # Bilinear values of the second view at the pixels of a row; 0 outside.
    height, width = detail.shape
    for i in range(len(inverse)):
        z = max(a[2, i] + b[2] * inverse[i], _NEAR)
        u, v = (a[0, i] + b[0] * inverse[i]) / z, (a[1, i] + b[1] * inverse[i]) / z
        to_detail[i] = to_usable[i] = np.float32(0)
        if u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1:
            x, y = min(int(u), width - 2), min(int(v), height - 2)
            s, t = u - np.float32(x), v - np.float32(y)
            p, q, r, k = (_ONE - s) * (_ONE - t), s * (_ONE - t), (_ONE - s) * t, s * t
            to_detail[i] = p * detail[y, x] + q * detail[y, x + 1] + r * detail[y + 1, x] + k * detail[y + 1, x + 1]
            to_usable[i] = p * usable[y, x] + q * usable[y, x + 1] + r * usable[y + 1, x] + k * usable[y + 1, x + 1]


@njit(cache=True, nogil=True, fastmath=REORDERED, inline="always")
def _add_row(first, second, weight, sign, columns):
    for x in range(len(weight)):
        w = sign * weight[x]
        columns[0, x] += w
        columns[1, x] += w * first[x]
        columns[2, x] += w * second[x]
        columns[3, x] += w * first[x] * first[x]
        columns[4, x] += w * second[x] * second[x]
        columns[5, x] += w * first[x] * second[x]


@njit(cache=True, nogil=True, fastmath=REORDERED, inline="always")
def _slide(columns, half, area, row):
    # The correlation at every pixel of a row, from sums over the columns of its windows.
    width = len(row)
    n = m1 = m2 = q1 = q2 = p = np.float32(0)
    noise, least = np.float32(NOISE * NOISE), np.float32(COVERED) * area
    for x in range(width + half):
        if x < width:
            n += columns[0, x]
            m1 += columns[1, x]
            m2 += columns[2, x]
            q1 += columns[3, x]
            q2 += columns[4, x]
            p += columns[5, x]
        if x > 2 * half:
            gone = x - 2 * half - 1
            n -= columns[0, gone]
            m1 -= columns[1, gone]
            m2 -= columns[2, gone]
            q1 -= columns[3, gone]
            q2 -= columns[4, gone]
            p -= columns[5, gone]
        if x >= half:
            score = np.float32(-1)
            if n > least:
                a, b = m1 / n, m2 / n
                variance1, variance2 = max(q1 / n - a * a, np.float32(0)), max(q2 / n - b * b, np.float32(0))
                score = (p / n - a * b) / np.sqrt(variance1 * variance2 + noise)
            row[x - half] = score


@njit(cache=True, nogil=True, fastmath=REORDERED)
def _mean_of_better_half(scores, out):
    num, height, width = scores.shape
    kept = (num + 1) // 2
    best = np.empty(kept, np.float32)
    for y in range(height):
        for x in range(width):
            best[:] = np.float32(-2)
            for k in range(num):
                value = scores[k, y, x]
                for i in range(kept):
                    if value > best[i]:
                        value, best[i] = best[i], value
            total = np.float32(0)
            for i in range(kept):
                total += best[i]
            out[y, x] = total / np.float32(kept)
