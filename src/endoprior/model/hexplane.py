"""HexPlane: features of (x, y, z, t) as products of six planes, at several spatial scales.

The planes hold tens of millions of numbers of which one step reads a small part, so they live outside the autograd
graph: `PlaneGrid.sample` and `PlaneGrid.linear` are differentiable in the position, and their backward adds the
gradient of the planes to the persistent buffer `PlaneGrid.grads`. `plane_adam.py` consumes that buffer.

Sampling is that of the published field: bilinear, corners aligned, border padding; product over the planes, features
of the scales concatenated (EndoGaussian; Cao and Johnson, "HexPlane", CVPR 2023).
"""

from __future__ import annotations

import math
from copy import copy
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import linear

from ..compute.compiled import compiled
from ..core.checks import check_shape
from ..core.config import HexPlaneConfig
from . import hexplane_kernels as kernels
from .hexplane_definition import Layout, features, layout_of
from .hexplane_lookup import Linear, Sample

PLANE_NAMES = ("xy", "xz", "yz", "xt", "yt", "zt")
_CACHE_LINE = 64
"""Bytes."""


def mapped_zeros(*shape: int) -> Tensor:
    """float32 zeros that begin on a cache line and take memory only where written: NumPy maps, torch would fill."""
    size = math.prod(shape)
    room = np.zeros(size + _CACHE_LINE // 4, dtype=np.float32)
    start = -room.ctypes.data % _CACHE_LINE // 4
    return torch.from_numpy(room[start : start + size]).view(shape)


def plane_shapes(cfg: HexPlaneConfig) -> list[dict[str, tuple[int, int]]]:
    """Rows and columns of each plane of each scale, by name; nothing is allocated.

    Columns run along the first letter of a name, rows along the second.
    """
    scales = [
        {**dict(zip("xyz", (r * m for r in cfg.resolution), strict=True)), "t": cfg.time_resolution}
        for m in cfg.multires
    ]
    return [{name: (cells[name[1]], cells[name[0]]) for name in PLANE_NAMES} for cells in scales]


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

    @property
    def num_values(self) -> int:
        """Trained numbers in all planes."""
        return self.num_cells * self.channels

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
        """A copy in half precision on a device, for look-ups only: without gradients, not to be trained."""
        return self._copy(self.values.detach().to(device, torch.float16))

    def _copy(self, values: Tensor) -> PlaneGrid:
        moved = copy(self)
        moved.values, moved.grads, moved.marks = values, values[:0], self.marks[:0]
        moved.__dict__.pop("layout", None)
        return moved

    @cached_property
    def layout(self) -> Layout:
        """Where the planes lie, for look-ups off the CPU."""
        return layout_of(self)

    def zeros(self) -> Tensor:
        """Zeros like `values`, where they are; on the CPU they take memory only once written."""
        on_cpu = self.values.device.type == "cpu"
        return mapped_zeros(self.num_cells, self.channels) if on_cpu else torch.zeros_like(self.values)

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
        self._check(unit, (time,))
        if torch.is_grad_enabled() and not unit.requires_grad:
            unit = unit.detach().requires_grad_(True)
        return Sample.apply(unit, time, self) if compiled(unit) else features(self, unit, (time,))[0]

    def linear(
        self, unit: Tensor, times: tuple[float | Tensor, ...], weight: Tensor, bias: Tensor
    ) -> tuple[Tensor, ...]:
        """A linear layer on the features of one or more moments.

        Equal to `sample(unit, time) @ weight.T + bias`, but the features, many times wider than what is made of them,
        do not leave the cache, and what does not depend on time is looked up once.

        Args:
            unit: (N, 3), as in `sample`.
            times: M moments in [0, 1]; off the CPU also as () float64 tensors.
            weight: (W, S * C). bias: (W,).
        Returns:
            (N, W) float32 per moment. With gradients, backward also adds to `grads`.
        Raises:
            ValueError: a wrong shape or a time that is not finite.
        """
        self._check(unit, times)
        check_shape(f"weight:W,{self.num_features} bias:W", weight=weight, bias=bias)
        if not compiled(unit):
            return tuple(linear(found, weight, bias) for found in features(self, unit, times))
        return Linear.apply(unit, weight, bias, times, self)

    def _check(self, unit: Tensor, times: tuple[float | Tensor, ...]) -> None:
        check_shape("unit:N,3", unit=unit)
        if not all(isinstance(time, Tensor) or np.isfinite(time) for time in times):
            raise ValueError(f"time must be finite; got {times!r}")
