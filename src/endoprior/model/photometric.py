"""Photometric model: what lies between the tissue's color and a frame: exposure, and light that smoke scatters back.

Each frame has a coarse grid of coefficients. A pixel of tissue color c shows sqrt(G c^2 + V), with gain G and veil V
interpolated bilinearly between the centers of the cells: the square is about the camera's gamma, so that light adds.
The tissue itself is shown without it, at the exposure of clear frames.

`T` frames, `I, J` rows and columns of the grid.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import interpolate

from ..compute.fastmath import REORDERED

Kind = Literal["none", "exposure", "smoke"]
"""`exposure`: one gain for each channel of a frame; `smoke`: a grid of gains and veils, the same for all channels."""
GRIDS: dict[str, tuple[int, int]] = {"exposure": (1, 1), "smoke": (18, 24)}
"""Rows and columns of the grid."""
LEAST, MOST = 0.02, 16.0
"""Range of the gains, of squared color."""
FLOOR = 1e-6  # of squared color: its root has a finite slope


def neutral(num_frames: int, kind: str) -> Tensor:
    """(T, I, J, 2, 3) coefficients that change nothing: gain 1, veil 0."""
    grid = torch.zeros(num_frames, *GRIDS[kind], 2, 3)
    grid[..., 0, :] = 1
    return grid


def filmed(color: Tensor, grid: Tensor) -> Tensor:
    """(H, W, 3) what the camera shows of tissue of a color (H, W, 3), by the coefficients (I, J, 2, 3) of its frame.

    Differentiable in `color`.
    """
    if color.device.type == "cpu" and color.dtype == torch.float32:
        return _Filmed.apply(color, grid)
    return filmed_torch(color, grid)


def filmed_torch(color: Tensor, grid: Tensor) -> Tensor:
    """See `filmed`."""
    cells = grid.permute(2, 3, 0, 1).reshape(1, 6, *grid.shape[:2]).to(color)
    gain, veil = interpolate(cells, color.shape[:2], mode="bilinear")[0].permute(1, 2, 0).split(3, -1)
    return (gain * color.clamp(min=0) ** 2 + veil).clamp(min=FLOOR).sqrt()


class _Filmed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, color: Tensor, grid: Tensor) -> Tensor:
        shown, slope = torch.empty_like(color), torch.empty_like(color)
        arrays = (t.detach().contiguous().numpy() for t in (color, grid))
        _rows(*arrays, shown.numpy(), slope.numpy())
        ctx.slope = slope
        return shown

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_shown: Tensor) -> tuple:
        return v_shown * ctx.slope, None


@njit(parallel=True, cache=True, fastmath=REORDERED)
def _rows(color, grid, shown, slope):
    # One task per row; writes shown and slope = d shown / d color, (H, W, 3).
    height, width, _ = color.shape
    rows, columns = grid.shape[:2]
    for y in prange(height):
        v = min(max((y + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
        i = int(v)
        below = np.float32(v - i)
        line = grid[i] + below * (grid[min(i + 1, rows - 1)] - grid[i])
        for x in range(width):
            u = min(max((x + 0.5) * columns / width - 0.5, 0.0), columns - 1.0)
            j = int(u)
            right, k = np.float32(u - j), min(j + 1, columns - 1)
            for c in range(3):
                gain = line[j, 0, c] + right * (line[k, 0, c] - line[j, 0, c])
                veil = line[j, 1, c] + right * (line[k, 1, c] - line[j, 1, c])
                value = max(color[y, x, c], np.float32(0))
                square = gain * value * value + veil
                root = np.sqrt(max(square, np.float32(FLOOR)))
                shown[y, x, c] = root
                slope[y, x, c] = gain * value / root if square > FLOOR else np.float32(0)


def between(grids: Tensor, frame: float) -> Tensor:
    """(I, J, 2, 3) coefficients at a position between frames, of those of all frames (T, I, J, 2, 3)."""
    position = min(max(frame, 0.0), len(grids) - 1.0)
    first = int(position)
    return torch.lerp(grids[first], grids[min(first + 1, len(grids) - 1)], position - first)


def of_all_frames(grids: Tensor, indices: tuple[int, ...] | list[int], num_frames: int) -> Tensor:
    """(T, I, J, 2, 3): held-out frames get what lies between the training frames around them, interpolated in time.

    Args:
        grids: (F, I, J, 2, 3) of the training frames `indices`, in order.
    """
    positions = np.interp(np.arange(num_frames), indices, np.arange(len(indices)))
    return torch.stack([between(grids, float(position)) for position in positions])


def possible(grids: Tensor) -> bool:
    """Whether stored coefficients can have been trained: gains in range, veils that take no light away."""
    gain, veil = grids.unbind(3)
    return bool((gain > 0).all() and (gain < 1e4).all() and (veil >= 0).all() and (veil < 1e4).all())
