"""Numba kernels of `flow_tracks`: one step along the flow, color error of tracks, filling of gaps.

Shared letters: `N` points, `T` frames. Pixels are float64 with centers at half integers; NaN is a lost point. Inputs
are not checked.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(parallel=True, cache=True)
def advance(pixels, active, there, back, tissue_mask, return_px, return_share, out):
    """Move active points (N, 2) by the flow `there` (h, w, 2); NaN off the tissue (H, W) or if `back` disagrees.

    Flow is in px of its own size. Inactive points in `out` do not change.
    """
    height, width = tissue_mask.shape
    scale_x, scale_y = width / there.shape[1], height / there.shape[0]
    for n in prange(len(pixels)):
        if active[n]:
            x, y = pixels[n]
            out[n] = np.nan
            if x == x:
                step_x, step_y = _flow(there, x / scale_x, y / scale_y)
                step_x, step_y = step_x * scale_x, step_y * scale_y
                x, y = x + step_x, y + step_y
                if 0 <= x <= width and 0 <= y <= height and tissue_mask[_cell(y, height), _cell(x, width)]:
                    back_x, back_y = _flow(back, x / scale_x, y / scale_y)
                    gap = np.hypot(step_x + back_x * scale_x, step_y + back_y * scale_y)
                    if gap <= return_px + return_share * np.hypot(step_x, step_y):
                        out[n, 0], out[n, 1] = x, y


@njit(parallel=True, cache=True)
def add_mismatch(image, pixels, active, static, own_gray, along_track, if_static):
    """Add |image - own_gray| along the track and at the `static` pixel, for active points (N, 2) with a known pixel."""
    for n in prange(len(pixels)):
        if active[n] and pixels[n, 0] == pixels[n, 0]:
            along_track[n] += abs(brightness(image, pixels[n, 0], pixels[n, 1]) - own_gray[n])
            if_static[n] += abs(brightness(image, static[n, 0], static[n, 1]) - own_gray[n])


@njit(parallel=True, cache=True)
def fill_gaps(offsets):
    """Replace NaN in offsets (T, N, 3): linear between known frames, constant before and after; 0 if none is known."""
    num_frames = len(offsets)
    for n in prange(offsets.shape[1]):
        last = -1
        for t in range(num_frames):
            if offsets[t, n, 0] == offsets[t, n, 0]:
                for k in range(last + 1, t):
                    share = (k - last) / (t - last)
                    for c in range(3):
                        start = offsets[last, n, c] if last >= 0 else offsets[t, n, c]
                        offsets[k, n, c] = start + share * (offsets[t, n, c] - start)
                last = t
        for k in range(last + 1, num_frames):
            for c in range(3):
                offsets[k, n, c] = offsets[last, n, c] if last >= 0 else 0.0


@njit(cache=True)
def brightness(image, x, y):
    """Bilinear value of an image (H, W); outside, the border value is repeated."""
    row, below, column, right, fx, fy = _place(x, y, image.shape[0], image.shape[1])
    above = (1 - fx) * image[row, column] + fx * image[row, right]
    return (1 - fy) * above + fy * ((1 - fx) * image[below, column] + fx * image[below, right])


@njit(inline="always")
def _flow(flow, x, y):
    row, below, column, right, fx, fy = _place(x, y, flow.shape[0], flow.shape[1])
    x = y = 0.0
    for i, j, weight in (
        (row, column, (1 - fx) * (1 - fy)),
        (row, right, fx * (1 - fy)),
        (below, column, (1 - fx) * fy),
        (below, right, fx * fy),
    ):
        x, y = x + weight * flow[i, j, 0], y + weight * flow[i, j, 1]
    return x, y


@njit(inline="always")
def _place(x, y, height, width):
    # Rows, columns and fractions of the four pixels around a position, as in `geometry.bilinear`.
    u, v = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    column, row = int(u), int(v)
    return row, min(row + 1, height - 1), column, min(column + 1, width - 1), u - column, v - row


@njit(inline="always")
def _cell(position, size):
    return min(int(position), size - 1)
