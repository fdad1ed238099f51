"""Normalized correlation of a frame with its partners at an inverse depth, in one pass over each pair.

Of windows of two views the zero-mean normalized correlation over what both show; of the partners the better half. Sums
over windows slide: down the columns, then along the rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...compute.simd import REORDERED
from ..camera_path.even_view import EvenView, Warp

NOISE = 2e-4  # variance of the detail that is noise
COVERED = 0.6  # least share of a window that both frames show
_SUMS = 6  # of weight, both details, both squares, their product
_NEAR, _ONE = np.float32(1e-3), np.float32(1)


def correlation(
    view: EvenView,
    partners: Sequence[EvenView],
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
