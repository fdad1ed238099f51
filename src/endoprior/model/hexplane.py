"""HexPlane: features of (x, y, z, t) as products of six planes, at several spatial scales. Here: the planes themselves.

The planes hold tens of millions of numbers of which one step reads a small part, so they live outside the autograd
graph: `hexplane_linear` (of `hexplane_numba.py` or `hexplane_torch.py`) is differentiable in the position, and its
backward pass adds the gradient of the planes to the persistent buffer `PlaneGrid.grads`, which the optimizer consumes.

Sampling is that of the published field: bilinear, corners aligned, border padding; product over the planes, features
of the scales concatenated (EndoGaussian; Cao and Johnson, "HexPlane", CVPR 2023).
"""

from __future__ import annotations

import math
from copy import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..core.config_deformation import HexPlaneConfig

PLANE_NAMES = ("xy", "xz", "yz", "xt", "yt", "zt")
TOUCHED, FRESH = 1, 2
"""Bits of `PlaneGrid.marks`: the cell ever had a gradient; it has one now."""
CACHE_LINE = 64
"""Bytes."""


def mapped_zeros(*shape: int) -> Tensor:
    """float32 zeros that begin on a cache line and take memory only where written: NumPy maps, torch would fill."""
    size = math.prod(shape)
    buffer = np.zeros(size + CACHE_LINE // 4, dtype=np.float32)
    start = -buffer.ctypes.data % CACHE_LINE // 4
    return torch.from_numpy(buffer[start : start + size]).view(shape)


def plane_shapes(cfg: HexPlaneConfig) -> list[dict[str, tuple[int, int]]]:
    """Rows and columns of each plane of each scale, by name; nothing is allocated.

    Columns run along the first letter of a name, rows along the second.
    """
    scales = [
        {**dict(zip("xyz", (r * m for r in cfg.resolution), strict=True)), "t": cfg.time_resolution}
        for m in cfg.multires
    ]
    return [{name: (cells[name[1]], cells[name[0]]) for name in PLANE_NAMES} for cells in scales]


class Layout(NamedTuple):
    """Where the planes lie in `PlaneGrid.values`; `S` scales, `R` columns of all time planes."""

    resolution: Tensor
    """(S, 3) float32 cells along x, y, z."""
    space_start: Tensor
    """(S, 3) first cell of the planes xy, xz, yz."""
    space_width: Tensor
    """(S, 3) cells from one row of the planes xy, xz, yz to the next."""
    table_start: Tensor
    """(S, 3) first column of the planes xt, yt, zt."""
    time_first: Tensor
    """(R,) cell that holds each column of the time planes in their first row."""
    time_step: Tensor
    """(R,) cells from one row of that column to the next."""


class PlaneGrid:
    """Plane values, their gradients and which cells were ever used.

    `values` (cells, C) float32 holds all planes; `plane(scale, name)` views one of them. `grads` has the same shape
    and its pages take memory only once written. `marks` (cells,) uint8 says which cells a gradient ever reached.
    """

    def __init__(self, cfg: HexPlaneConfig) -> None:
        """Allocate planes filled with 1. `initialize` draws the starting values of the space planes."""
        space = np.array([[r * m for r in cfg.resolution] for m in cfg.multires], dtype=np.int64).reshape(-1, 3)
        self.resolution = space
        self.time_resolution = cfg.time_resolution
        self.time_map = cfg.time_map
        self.channels = cfg.channels
        self._shapes = [[shapes[name] for name in PLANE_NAMES] for shapes in plane_shapes(cfg)]
        sizes = np.array([[rows * columns for rows, columns in scale] for scale in self._shapes], dtype=np.int64)
        starts = (np.cumsum(sizes) - sizes.ravel()).reshape(-1, 6)
        self.space_start, self.time_start = starts[:, :3].copy(), starts[:, 3:].copy()
        self._starts = starts
        self.table_start = (np.cumsum(space) - space.ravel()).reshape(-1, 3)
        self.num_cells = int(sizes.sum())
        self.values = torch.ones(self.num_cells, self.channels)
        self.grads = self.zeros()
        self.marks = torch.zeros(self.num_cells, dtype=torch.uint8)

    @property
    def num_scales(self) -> int:
        """S."""
        return len(self.resolution)

    @property
    def num_features(self) -> int:
        """Width of a feature, S * C."""
        return self.num_scales * self.channels

    def plane(self, scale: int, name: str, of: Tensor | None = None) -> Tensor:
        """View (rows, columns, C) of one plane of `values`, or of another tensor with one row per cell.

        Columns run along the first letter of `name`, rows along the second.
        """
        index = PLANE_NAMES.index(name)
        rows, columns = self._shapes[scale][index]
        start = int(self._starts[scale, index])
        source = self.values if of is None else of
        return source[start : start + rows * columns].view(rows, columns, -1)

    def initialize(self, generator: torch.Generator) -> None:
        """Draw the space planes from U[0.1, 0.5] and set the time planes to 1 (EndoGaussian)."""
        for scale in range(self.num_scales):
            for name in PLANE_NAMES[:3]:
                self.plane(scale, name).uniform_(0.1, 0.5, generator=generator)
            for name in PLANE_NAMES[3:]:
                self.plane(scale, name).fill_(1)

    def to(self, device: torch.device) -> PlaneGrid:
        """A copy on a device, without gradients."""
        moved = self._copy(self.values.detach().to(device))
        moved.marks = self.marks.to(device)
        moved.grads = moved.zeros()
        return moved

    def to_fp16(self, device: torch.device) -> PlaneGrid:
        """A copy in half precision on a device, for look-ups only: it has no gradients and cannot be trained."""
        return self._copy(self.values.detach().to(device, torch.float16))

    def _copy(self, values: Tensor) -> PlaneGrid:
        moved = copy(self)
        moved.values, moved.grads, moved.marks = values, values[:0], self.marks[:0]
        moved.__dict__.pop("layout", None)
        return moved

    @cached_property
    def layout(self) -> Layout:
        """Where the planes lie, as tensors on the device of `values`."""
        size = torch.from_numpy(self.resolution)
        first, step = [], []
        for starts, cells in zip(self.time_start.tolist(), self.resolution.tolist(), strict=True):
            for start, count in zip(starts, cells, strict=True):
                first.append(start + torch.arange(count))
                step.append(torch.full((count,), count))
        tables = (
            size.float(),
            torch.from_numpy(self.space_start),
            torch.stack([size[:, 0], size[:, 0], size[:, 1]], 1),
            torch.from_numpy(self.table_start),
            torch.cat(first),
            torch.cat(step),
        )
        return Layout(*(table.to(self.values.device) for table in tables))

    def zeros(self) -> Tensor:
        """Zeros like `values`, where they are; on the CPU they take memory only once written."""
        on_cpu = self.values.device.type == "cpu"
        return mapped_zeros(self.num_cells, self.channels) if on_cpu else torch.zeros_like(self.values)

    def clear_grads(self) -> None:
        """Forget gradients that no optimizer step consumed; cells stay marked as touched."""
        fresh = (self.marks & FRESH).nonzero()[:, 0]
        self.grads[fresh] = 0
        self.marks &= TOUCHED

    def time_row(self, time: float) -> tuple[int, np.float32]:
        """Row r and fraction f of the time planes at `time`: the sample is (1 - f) * row r + f * row r + 1.

        `raw` takes t itself as the coordinate in [-1, 1], `full` takes 2 t - 1; both are clamped to the planes.
        """
        last = self.time_resolution - 1
        position = (time if self.time_map == "full" else (time + 1) / 2) * last
        position = min(max(position, 0.0), float(last))
        row = min(int(position), last - 1)
        return row, np.float32(position - row)
