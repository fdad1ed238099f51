"""HexPlane: features of (x, y, z, t) as products of six planes, at several spatial scales.

The planes hold tens of millions of numbers of which one step reads a small part, so they live outside the autograd
graph: `PlaneGrid.sample` is differentiable in the position, and its backward adds the gradient of the planes to the
persistent buffer `PlaneGrid.grads`. `plane_adam.py` consumes that buffer.

Sampling is that of the published field: bilinear, corners aligned, border padding; product over the planes, features
of the scales concatenated (EndoGaussian; Cao and Johnson, "HexPlane", CVPR 2023).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..checks import InputError, check_shape
from ..config import HexPlaneConfig
from . import hexplane_kernels as kernels

PLANE_NAMES = ("xy", "xz", "yz", "xt", "yt", "zt")
_COLUMN_AXES = (0, 0, 1, 0, 1, 2)
_SPACE_ROW_AXES = (1, 2, 2)


class PlaneGrid:
    """Plane values, their gradients and which cells were ever used.

    `values` (cells, C) float32 holds all planes; `plane(scale, name)` views one of them. `grads` has the same shape
    and its pages take memory only once written. `marks` (cells,) uint8 says which cells a gradient ever reached.
    """

    def __init__(self, cfg: HexPlaneConfig) -> None:
        """Allocate planes filled with 1. `initialize` draws the starting values of the space planes.

        Raises:
            InputError: a resolution below 2, no scale, or channels outside 1..256.
        """
        if not 1 <= cfg.channels <= kernels.MAX_CHANNELS:
            raise InputError(
                f"deformation.hexplane.channels: expected 1 to {kernels.MAX_CHANNELS}; got {cfg.channels}. "
                "Choose fewer channels or more scales."
            )
        space = np.array([[r * m for r in cfg.resolution] for m in cfg.multires], dtype=np.int64).reshape(-1, 3)
        if not len(space) or min(space.min(), cfg.time_resolution) < 2:
            raise InputError(
                "deformation.hexplane: expected at least one scale and two cells along every axis; "
                f"got {cfg.resolution} x {cfg.multires}, {cfg.time_resolution} in time. Raise the resolution."
            )
        self.resolution = space
        self.time_resolution = cfg.time_resolution
        self.time_map = cfg.time_map
        self.channels = cfg.channels
        self._shapes = [[self._plane_shape(s, p) for p in range(6)] for s in range(len(space))]
        sizes = np.array([[rows * columns for rows, columns in scale] for scale in self._shapes], dtype=np.int64)
        starts = (np.cumsum(sizes) - sizes.ravel()).reshape(-1, 6)
        self.space_start, self.time_start = starts[:, :3].copy(), starts[:, 3:].copy()
        self._starts = starts
        self.table_start = (np.cumsum(space) - space.ravel()).reshape(-1, 3)
        self.num_cells = int(sizes.sum())
        self.values = torch.ones(self.num_cells, self.channels)
        # NumPy's zeros are mapped, not written: cells that no Gaussian reaches cost no memory.
        self.grads = torch.from_numpy(np.zeros((self.num_cells, self.channels), dtype=np.float32))
        self.marks = torch.zeros(self.num_cells, dtype=torch.uint8)

    @property
    def num_scales(self) -> int:
        """S."""
        return len(self.resolution)

    @property
    def num_features(self) -> int:
        """Width of a feature, S * C."""
        return self.num_scales * self.channels

    @property
    def num_values(self) -> int:
        """Trained numbers in all planes."""
        return self.num_cells * self.channels

    def _plane_shape(self, scale: int, plane: int) -> tuple[int, int]:
        """Rows and columns of a plane."""
        rows = self.resolution[scale, _SPACE_ROW_AXES[plane]] if plane < 3 else self.time_resolution
        return int(rows), int(self.resolution[scale, _COLUMN_AXES[plane]])

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

    def clear_grads(self) -> None:
        """Forget gradients that no optimizer step consumed; cells stay marked as touched."""
        fresh = (self.marks & kernels.FRESH).nonzero()[:, 0]
        self.grads[fresh] = 0
        self.marks &= kernels.TOUCHED

    def time_row(self, time: float) -> tuple[int, np.float32]:
        """Row r and fraction f of the time planes at `time`: the sample is (1 - f) * row r + f * row r + 1.

        `raw` takes t itself as the coordinate in [-1, 1], `full` takes 2 t - 1; both are clamped to the planes.
        """
        last = self.time_resolution - 1
        position = (time if self.time_map == "full" else (time + 1) / 2) * last
        position = min(max(position, 0.0), float(last))
        row = min(int(position), last - 1)
        return row, np.float32(position - row)

    def sample(self, unit: Tensor, time: float) -> Tensor:
        """Features at one moment.

        Args:
            unit: (N, 3) float32 positions, 0..1 from the first to the second corner of the box; clamped outside.
            time: in [0, 1].
        Returns:
            (N, S * C) float32. When gradients are enabled its backward also adds to `grads`, even if `unit` itself
            needs no gradient.
        Raises:
            ValueError: a wrong shape or a time that is not finite.
        """
        check_shape("unit:N,3", unit=unit)
        if not np.isfinite(time):
            raise ValueError(f"time must be finite; got {time!r}")
        if torch.is_grad_enabled() and not unit.requires_grad:
            unit = unit.detach().requires_grad_(True)
        return _Sample.apply(unit, time, self)


class _Sample(torch.autograd.Function):
    """Bridge between autograd and the kernels."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, time: float, grid: PlaneGrid) -> Tensor:
        row, fraction = grid.time_row(time)
        values = grid.values.numpy()
        tables = np.empty((int(grid.resolution.sum()), grid.channels), dtype=np.float32)
        kernels.slice_time(values, grid.time_start, grid.table_start, grid.resolution, row, fraction, tables)
        out = np.empty((len(unit), grid.num_scales, grid.channels), dtype=np.float32)
        positions = unit.detach().contiguous()
        kernels.gather(positions.numpy(), values, tables, grid.space_start, grid.table_start, grid.resolution, out)
        ctx.save_for_backward(positions)
        ctx.grid, ctx.moment, ctx.tables = grid, (row, fraction), tables
        return torch.from_numpy(out).view(len(unit), grid.num_features)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor, None, None]:
        grid: PlaneGrid = ctx.grid
        (positions,) = ctx.saved_tensors
        unit, tables, num = positions.numpy(), ctx.tables, len(positions)
        values, grads, marks = grid.values.numpy(), grid.grads.numpy(), grid.marks.numpy()
        v_features = v_out.contiguous().numpy().reshape(num, grid.num_scales, grid.channels)
        v_unit = np.zeros((num, 3), dtype=np.float32)
        v_samples = np.empty((6, num, grid.channels), dtype=np.float32)  # of one scale at a time, to save memory
        v_tables, table_marks = np.zeros_like(tables), np.zeros(len(tables), dtype=np.uint8)
        layout = (grid.space_start, grid.table_start, grid.resolution)
        for s in range(grid.num_scales):
            kernels.gather_backward(s, unit, values, tables, *layout, v_features, v_samples, v_unit)
            kernels.scatter(s, unit, v_samples, *layout, grads, v_tables, marks, table_marks)
        kernels.slice_time_backward(
            v_tables, table_marks, grid.time_start, grid.table_start, grid.resolution, *ctx.moment, grads, marks
        )
        return torch.from_numpy(v_unit), None, None
