"""How canonical Gaussians move: the offsets at one time, and the HexPlane field that predicts them.

Offsets are added to the raw parameters: centers (mm), log scales, quaternions before normalization, opacity logits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from ..core.checks import InputError, check_shape
from ..core.config_deformation import DeformationConfig
from .attributes import offset_widths
from .field import Field
from .heads import LinearLayers, OffsetHeads, head_shapes
from .hexplane import PLANE_NAMES, PlaneGrid, plane_shapes
from .ops import ModelOps


@dataclass(frozen=True)
class Offsets:
    """What one time step adds to the raw parameters of N Gaussians; None where nothing is added."""

    means: Tensor
    """(N, 3) displacement of the centers, mm."""
    log_scales: Tensor | None = None
    """(N, 3)."""
    quats: Tensor | None = None
    """(N, 4), added before normalization."""
    opacity_logits: Tensor | None = None
    """(N,)."""
    sh_dc: Tensor | None = None
    """(N, 3), added to the spherical-harmonic coefficient of degree 0."""
    sh_rest: Tensor | None = None
    """(N, (D+1)**2 - 1, 3), added to those of the other degrees."""

    @staticmethod
    def from_channels(channels: dict[str, Tensor], cfg: DeformationConfig) -> Offsets:
        """Offsets from tensors (N, width) by name, as `attributes.offset_widths` names them; scales within bounds."""
        if "opacity_logits" in channels:
            channels["opacity_logits"] = channels["opacity_logits"][:, 0]
        if "log_scales" in channels and cfg.max_scale_change > 1:
            limit = math.log(cfg.max_scale_change)
            channels["log_scales"] = channels["log_scales"].clamp(-limit, limit)
        return Offsets(**channels)


class HexPlaneField(Field):
    """The paper's deformation field: box, planes, trunk and heads."""

    grid: PlaneGrid

    def __init__(self, box: Tensor, cfg: DeformationConfig, generator: torch.Generator, *, draw: bool = True) -> None:
        """Start a field.

        Args:
            box: (2, 3) corners, mm, in the order [max, min]; `box_of_points` makes one.
            generator: source of all random numbers: space planes first, then trunk and heads.
            draw: False leaves the planes at 1.
        """
        check_shape("box:2,3", box=box)
        self.cfg = cfg
        self.grid = PlaneGrid(cfg.hexplane)
        if draw:
            self.grid.initialize(generator)
        self.box = box.detach().to(torch.float32).clone().requires_grad_(cfg.hexplane.learn_box)
        self.heads = self.make_heads(cfg, generator)

    @classmethod
    def make_heads(cls, cfg: DeformationConfig, generator: torch.Generator) -> LinearLayers:
        """Trunk and heads with fresh weights."""
        return OffsetHeads(num_features(cfg), cfg.hexplane.width, offset_widths(cfg), cfg.hexplane.bias_init, generator)

    @classmethod
    def layer_shapes(cls, cfg: DeformationConfig) -> dict[str, tuple[int, int]]:
        """Outputs and inputs of each layer of trunk and heads."""
        return head_shapes(num_features(cfg), cfg.hexplane.width, offset_widths(cfg))

    @classmethod
    def from_points(cls, points: Tensor, cfg: DeformationConfig, generator: torch.Generator) -> Self:
        """A field whose box holds the initial points (N, 3), mm."""
        return cls(box_of_points(points), cfg, generator)

    @classmethod
    def from_state_arrays(cls, arrays: Mapping[str, Tensor], cfg: DeformationConfig) -> Self:
        """The field whose `state_arrays` these are.

        Raises:
            InputError: an array is missing or has another shape.
        """
        field = cls(torch.tensor([[1.0] * 3, [0.0] * 3]), cfg, torch.Generator(), draw=False)
        field.load_state_arrays(arrays)
        return field

    def to(self, device: torch.device | str, *, fp16_planes: bool = False) -> HexPlaneField:
        """This field on a device; itself if it is there. A copy starts without gradients.

        Args:
            fp16_planes: keep the planes in half precision, on any device but the CPU: for rendering only.
        """
        device = torch.device(device)
        if self.box.device.type == device.type and not fp16_planes:
            return self
        moved = copy(self)
        moved.grid = self.grid.to_fp16(device) if fp16_planes else self.grid.to(device)
        moved.heads = self.heads.to(device)
        moved.box = self.box.detach().to(device).requires_grad_(self.box.requires_grad)
        return moved

    def offsets(self, means: Tensor, time: float, ops: ModelOps) -> Offsets:
        """Offsets at `time` of Gaussians with canonical centers `means`.

        Args:
            means: (N, 3) float32, world axes, mm; any subset of the Gaussians, N may be 0.
            time: in [0, 1).
        Returns:
            Offsets with a gradient path to `means`, the box and the network; the planes' gradient goes to `grid.grads`.
        """
        (trunk,) = self.trunk(means, (time,), ops)
        return Offsets.from_channels(self.heads(trunk, ops), self.cfg)

    def offsets_and_displacement(
        self, means: Tensor, time: float, other: float, ops: ModelOps
    ) -> tuple[Offsets, Tensor]:
        """`offsets` at `time`, and those of the centers alone, (N, 3) mm, at an `other` time: faster than two calls."""
        here, there = self.trunk(means, (time, other), ops)
        return Offsets.from_channels(self.heads(here, ops), self.cfg), self.heads(there, ops, ("means",))["means"]

    def trunk(self, means: Tensor, times: tuple[float, ...], ops: ModelOps) -> tuple[Tensor, ...]:
        """Output of the trunk on the features, (N, W) per time."""
        # As in the paper's code the first corner is the maximum, so coordinates run against the axes.
        unit = (means - self.box[0]) / (self.box[1] - self.box[0])
        if not np.isfinite(times).all():
            raise ValueError(f"time must be finite; got {times!r}")
        return ops.hexplane_linear(self.grid, unit, times, *self.heads.trunk)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Network and box by name; the box only if it is trained. See `Field.parameters`."""
        named = {f"network.{i}": value for i, value in enumerate(self.heads.parameters.values())}
        return named | ({"box": self.box} if self.box.requires_grad else {})

    @classmethod
    def state_shapes(cls, cfg: DeformationConfig) -> dict[str, tuple[int, ...]]:
        """Names and shapes of `state_arrays`, all float32, in the same order; nothing is allocated."""
        shapes: dict[str, tuple[int, ...]] = {"hexplane.box": (2, 3)}
        for scale, planes in enumerate(plane_shapes(cfg.hexplane)):
            shapes |= {f"hexplane.{scale}.{name}": (*size, cfg.hexplane.channels) for name, size in planes.items()}
        for name, weight in cls.layer_shapes(cfg).items():
            shapes |= {f"heads.{name}.weight": weight, f"heads.{name}.bias": weight[:1]}
        return shapes

    @classmethod
    def parameter_shapes(cls, cfg: DeformationConfig) -> dict[str, tuple[int, ...]]:
        """Names and shapes of `parameters`."""
        shapes = cls.state_shapes(cfg)
        heads = [shape for name, shape in shapes.items() if name.startswith("heads.")]
        named = {f"network.{i}": shape for i, shape in enumerate(heads)}
        return named | ({"box": shapes["hexplane.box"]} if cfg.hexplane.learn_box else {})

    def state_arrays(self) -> dict[str, Tensor]:
        """Every number that defines the field, by name; views of live memory, not copies."""
        arrays = {"hexplane.box": self.box.detach()}
        for scale in range(self.grid.num_scales):
            arrays |= {f"hexplane.{scale}.{name}": self.grid.plane(scale, name) for name in PLANE_NAMES}
        return arrays | {f"heads.{name}": value.detach() for name, value in self.heads.parameters.items()}

    def load_state_arrays(self, arrays: Mapping[str, Tensor]) -> None:
        """Copy in what `state_arrays` gave; other names in `arrays` are ignored.

        Raises:
            InputError: an array is missing or has another shape.
        """
        for name, target in self.state_arrays().items():
            found = arrays.get(name)
            if found is None or found.shape != target.shape:
                shape = None if found is None else tuple(found.shape)
                raise InputError(
                    f"{name}: expected an array of shape {tuple(target.shape)}; got {shape or 'none'}. "
                    "Load the scene with the configuration it was trained with."
                )
            target.copy_(found)


def num_features(cfg: DeformationConfig) -> int:
    """Width of the feature of a point: channels of all scales."""
    return len(cfg.hexplane.multires) * cfg.hexplane.channels


def box_of_points(points: Tensor) -> Tensor:
    """Box (2, 3) in the order [max, min] around points (N, 3), mm.

    An axis along which all points agree would divide by zero: its two corners are moved apart by 1 mm.

    Raises:
        ValueError: no points, or points that are not finite.
    """
    check_shape("points:N,3", points=points)
    if not len(points) or not torch.isfinite(points).all():
        raise ValueError(f"points must be finite and at least one; got {len(points)} of them")
    high, low = points.detach().amax(0), points.detach().amin(0)
    flat = (high <= low).to(high.dtype) / 2
    return torch.stack([high + flat, low - flat])
