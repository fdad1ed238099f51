"""Photometric model: smoke between the tissue and the camera, apart from the tissue.

Each frame has a coarse grid of coefficients. A pixel of tissue color c shows sqrt(g c^2 + v): the gain g is the share
of its light that comes through, the veil v the light that smoke scatters back. Both are interpolated bilinearly between
the centers of cells, and the same for all channels: smoke is gray. Light adds in squares, about the camera's gamma.

`T` frames, `I, J` rows and columns of a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import interpolate

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import REORDERED
from ..core.types import RenderedView

GRID = (18, 24)
"""Rows and columns of the grids that training finds."""
FLOOR = 1e-8  # added to squared color: the slope of its root is finite


def add_smoke(color: Tensor, grid: Tensor) -> Tensor:
    """What a camera sees of tissue through smoke; differentiable in `color`.

    Args:
        color: (H, W, 3) of the tissue. grid: (I, J, 2) gain and veil of the frame.
    """
    if color.device.type == "cpu" and color.dtype == torch.float32:
        return _AddSmoke.apply(color, grid)
    return add_smoke_torch(color, grid)


def add_smoke_torch(color: Tensor, grid: Tensor) -> Tensor:
    """See `add_smoke`."""
    cells = grid.permute(2, 0, 1)[None].to(color)
    gain, veil = interpolate(cells, color.shape[:2], mode="bilinear")[0].unsqueeze(-1)
    return (gain * color.clamp(min=0) ** 2 + veil + FLOOR).sqrt()


def behind_smoke(view: RenderedView, grid: Tensor | None) -> RenderedView:
    """A view of tissue as it looks through smoke of coefficients (I, J, 2); itself without any."""
    return view if grid is None else replace(view, unclamped_color=add_smoke(view.unclamped_color, grid))


class _AddSmoke(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, color: Tensor, grid: Tensor) -> Tensor:
        color, grid = color.detach().contiguous(), grid.contiguous()
        shown, slope = torch.empty_like(color), torch.empty_like(color)
        _rows(color.numpy(), grid.numpy(), shown.numpy(), slope.numpy())
        ctx.slope = slope
        return shown

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_shown: Tensor) -> tuple:
        return ctx.slope * v_shown, None


@parallel_njit(fastmath=REORDERED)
def _rows(color, grid, shown, slope):
    # One task per row y: writes shown[y] and slope[y] = d shown / d color. A row is one flat run of numbers, three per
    # pixel: loops over it vectorize.
    height, width, _ = color.shape
    rows, columns = grid.shape[:2]
    zero, floor = np.float32(0), np.float32(FLOOR)
    colors, all_shown = color.reshape(height, 3 * width), shown.reshape(height, 3 * width)
    slopes = slope.reshape(height, 3 * width)
    left, right = np.empty(width, np.int64), np.empty(width, np.float32)
    for x in range(width):
        u = min(max((x + 0.5) * columns / width - 0.5, 0.0), columns - 1.0)
        left[x], right[x] = min(int(u), columns - 2), u - min(int(u), columns - 2)
    for y in prange(height):
        v = min(max((y + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
        i = int(v)
        line = grid[i] + np.float32(v - i) * (grid[min(i + 1, rows - 1)] - grid[i])
        both = np.empty((2, 3 * width), np.float32)
        for x in range(width):
            j = left[x]
            for c in range(2):
                value = line[j, c] + right[x] * (line[j + 1, c] - line[j, c])
                both[c, 3 * x] = both[c, 3 * x + 1] = both[c, 3 * x + 2] = value
        row, shown_row, slope_row, gain, veil = colors[y], all_shown[y], slopes[y], both[0], both[1]
        for n in range(3 * width):
            value = max(row[n], zero)
            scaled = gain[n] * value
            root = np.sqrt(scaled * value + veil[n] + floor)
            shown_row[n] = root
            slope_row[n] = scaled / root


def between(grids: Tensor, position: float) -> Tensor:
    """(I, J, 2) coefficients at a position between frames, interpolated in time from those of frames (T, I, J, 2)."""
    position = min(max(position, 0.0), len(grids) - 1.0)
    first = int(position)
    return torch.lerp(grids[first], grids[min(first + 1, len(grids) - 1)], position - first)


def of_all_frames(grids: Tensor, indices: Sequence[int], num_frames: int) -> Tensor:
    """(T, I, J, 2) of all frames from those of the training frames `indices`, (F, I, J, 2).

    Held-out frames get what lies between their neighbors: nothing is fitted to them.
    """
    positions = np.interp(np.arange(num_frames), indices, np.arange(len(indices)))
    return torch.stack([between(grids, float(position)) for position in positions])


def is_possible(grids: Tensor) -> bool:
    """Whether stored coefficients can be those of a training."""
    gain, veil = grids.unbind(-1)
    return bool((gain > 0).all() and (gain < 1e3).all() and (veil >= 0).all() and (veil < 1e3).all())
