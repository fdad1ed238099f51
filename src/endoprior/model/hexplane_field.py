"""The paper's deformation field: HexPlane features, one shared linear trunk, one head per attribute.

trunk: linear F -> W. Head: ReLU, linear W -> W, ReLU, linear W -> outputs (EndoGaussian). Weights start Xavier
uniform, so the offsets are not zero at the start.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from typing import ClassVar, Self, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import linear, relu
from torch.nn.init import xavier_uniform_
from typing_extensions import override

from ..core.checks import InputError, check_shape
from ..core.config import Config
from ..core.config_deformation import DeformationConfig, HexPlaneConfig
from .gaussians import Gaussians, Offsets, offset_widths
from .hexplane import PLANE_NAMES, PlaneGrid, plane_shapes
from .motion import Field, ModelOps, Motion


class HexPlaneField(Field):
    """The paper's deformation field: box, planes, trunk and heads."""

    width: ClassVar[int] = 32
    """Hidden width of trunk and heads."""
    learns_box: ClassVar[bool] = True
    """The box is trained together with the planes, as EndoGaussian does without saying so."""
    grid: PlaneGrid

    def __init__(
        self,
        box: Tensor,
        cfg: DeformationConfig,
        generator: torch.Generator,
        *,
        draw: bool = True,
        zero_biases: bool = False,
    ) -> None:
        """Args:
        box: (2, 3) corners, mm, in the order [max, min]; `box_of_points` makes one.
        generator: source of all random numbers: space planes first, then trunk and heads.
        draw: False leaves the planes at 1.
        zero_biases: biases of trunk and heads start at 0 (released code).
        """
        check_shape("box:2,3", box=box)
        self.cfg = cfg
        self.grid = PlaneGrid(cfg.hexplane)
        if draw:
            self.grid.initialize(generator)
        self.box = box.detach().to(torch.float32).clone().requires_grad_(self.learns_box)
        self.heads = self.make_heads(cfg, generator, zero_biases)

    @classmethod
    def make_heads(cls, cfg: DeformationConfig, generator: torch.Generator, zero_biases: bool) -> LinearLayers:
        """Trunk and heads with fresh weights."""
        return OffsetHeads(cls.layer_shapes(cfg), generator, zero_biases)

    @classmethod
    def layer_shapes(cls, cfg: DeformationConfig) -> dict[str, tuple[int, int]]:
        """Outputs and inputs of each layer of trunk and heads."""
        return head_shapes(num_features(cfg), cls.width, offset_widths(cfg))

    @classmethod
    def from_points(
        cls, points: Tensor, cfg: DeformationConfig, generator: torch.Generator, zero_biases: bool = False
    ) -> Self:
        """A field whose box holds the initial points (N, 3), mm."""
        return cls(box_of_points(points), cfg, generator, zero_biases=zero_biases)

    @classmethod
    def from_state_arrays(cls, arrays: Mapping[str, Tensor], cfg: DeformationConfig) -> Self:
        """See `Motion.field_of`."""
        field = cls(torch.tensor([[1.0] * 3, [0.0] * 3]), cfg, torch.Generator(), draw=False)
        field.load_state_arrays(arrays)
        return field

    def to(self, device: torch.device | str, *, fp16_planes: bool = False) -> HexPlaneField:
        """See `Field.to`."""
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
        return Offsets.from_channels(self._heads(trunk, ops), self.cfg)

    def offsets_and_displacement(
        self, means: Tensor, time: float, other: float, ops: ModelOps
    ) -> tuple[Offsets, Tensor]:
        """`offsets` at `time`, and those of the centers alone, (N, 3) mm, at an `other` time: faster than two calls."""
        here, there = self.trunk(means, (time, other), ops)
        return Offsets.from_channels(self._heads(here, ops), self.cfg), self._heads(there, ops, ("means",))["means"]

    def _heads(self, trunk: Tensor, ops: ModelOps, only: tuple[str, ...] | None = None) -> dict[str, Tensor]:
        assert isinstance(self.heads, OffsetHeads)
        return self.heads(trunk, ops, only)

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
        return named | ({"box": shapes["hexplane.box"]} if cls.learns_box else {})

    def state_arrays(self) -> dict[str, Tensor]:
        """Every number that defines the field, by name; views of live memory, not copies."""
        arrays = {"hexplane.box": self.box.detach()}
        for scale in range(self.grid.num_scales):
            arrays |= {f"hexplane.{scale}.{name}": self.grid.plane(scale, name) for name in PLANE_NAMES}
        return arrays | {f"heads.{name}": value.detach() for name, value in self.heads.parameters.items()}

    def load_state_arrays(self, arrays: Mapping[str, Tensor]) -> None:
        """Copy in what `state_arrays` gave; InputError if an array is missing or has another shape."""
        for name, target in self.state_arrays().items():
            found = arrays.get(name)
            if found is None or found.shape != target.shape:
                shape = None if found is None else tuple(found.shape)
                raise InputError(
                    f"{name}: expected an array of shape {tuple(target.shape)}; got {shape or 'none'}. "
                    "Load the scene with the configuration it was trained with."
                )
            target.copy_(found)


class HexPlaneMotion(Motion):
    """The paper's: a field of space-time planes."""

    field_class: type[HexPlaneField] = HexPlaneField

    def field(self, points: Tensor, cfg: Config) -> HexPlaneField:
        """See `Motion.field`."""
        generator = torch.Generator().manual_seed(cfg.seed)
        return self.field_class.from_points(points, cfg.deformation, generator, cfg.released.zero_biases)

    def field_of(self, arrays: Mapping[str, Tensor], cfg: Config) -> HexPlaneField:
        """See `Motion.field_of`."""
        return self.field_class.from_state_arrays(arrays, cfg.deformation)

    def field_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.field_shapes`."""
        return self.field_class.state_shapes(cfg.deformation)

    def parameter_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.parameter_shapes`."""
        return self.field_class.parameter_shapes(cfg.deformation)

    def planes(self, cfg: Config) -> HexPlaneConfig:
        """See `Motion.planes`."""
        return cfg.deformation.hexplane

    @override
    def offsets(
        self,
        gaussians: Gaussians,
        field: Field | None,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """See `Motion.offsets`."""
        means = gaussians["means"]
        return cast("HexPlaneField", field).offsets(means if chosen is None else means[chosen], time, ops)


class LinearLayers:
    """Linear layers by name; `parameters` names every trained tensor. The layer `trunk` reads a field's features."""

    def __init__(
        self, shapes: dict[str, tuple[int, int]], generator: torch.Generator, zero_biases: bool = False
    ) -> None:
        """Draw weights, and biases from U[-1, 1] / sqrt(inputs) as PyTorch does, unless they start at 0.

        Args:
            shapes: outputs and inputs of each layer by name.
        """
        self.parameters: dict[str, Tensor] = {}
        for layer, (fan_out, fan_in) in shapes.items():
            weight, bias = torch.empty(fan_out, fan_in), torch.zeros(fan_out)
            xavier_uniform_(weight, generator=generator)
            if not zero_biases:
                bias.uniform_(-1 / math.sqrt(fan_in), 1 / math.sqrt(fan_in), generator=generator)
            self.parameters[f"{layer}.weight"] = weight.requires_grad_(True)
            self.parameters[f"{layer}.bias"] = bias.requires_grad_(True)

    def to(self, device: torch.device) -> Self:
        """A copy on a device."""
        moved = copy(self)
        moved.parameters = {
            name: value.detach().to(device).requires_grad_(True) for name, value in self.parameters.items()
        }
        return moved

    @property
    def trunk(self) -> tuple[Tensor, Tensor]:
        """Weight (W, F) and bias (W,) of the linear trunk; `ops.hexplane_linear` applies it to the features."""
        return self.layer("trunk")

    def layer(self, name: str) -> tuple[Tensor, Tensor]:
        """Weight (outputs, inputs) and bias (outputs,) of a layer."""
        return self.parameters[f"{name}.weight"], self.parameters[f"{name}.bias"]

    def linear(self, layer: str, inputs: Tensor) -> Tensor:
        """One linear layer by name."""
        return linear(inputs, *self.layer(layer))


def head_shapes(num_features: int, width: int, outputs: dict[str, int]) -> dict[str, tuple[int, int]]:
    """Outputs and inputs of the layers of `OffsetHeads`, by name.

    Args:
        num_features: F, width of the feature. width: W, hidden width.
        outputs: what to predict and how many numbers of each, as `gaussians.offset_widths` gives them.
    """
    shapes = {"trunk": (width, num_features)}
    for name, num in outputs.items():
        shapes |= {f"{name}.hidden": (width, width), f"{name}.output": (num, width)}
    return shapes


class OffsetHeads(LinearLayers):
    """Trunk and heads, of `head_shapes`."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """What the heads predict."""
        return tuple(name.removesuffix(".output.weight") for name in self.parameters if name.endswith(".output.weight"))

    def __call__(self, trunk: Tensor, ops: ModelOps, only: tuple[str, ...] | None = None) -> dict[str, Tensor]:
        """Offsets (N, outputs) by name from the output of the trunk, (N, W); of the heads in `only`, if given."""
        shared, names = relu(trunk), only or self.outputs
        if ops.fuse_heads:
            weight = torch.cat([self.parameters[f"{name}.hidden.weight"] for name in names])
            bias = torch.cat([self.parameters[f"{name}.hidden.bias"] for name in names])
            hidden = linear(shared, weight, bias).chunk(len(names), -1)
        else:
            hidden = [self.linear(f"{name}.hidden", shared) for name in names]
        return {name: self.linear(f"{name}.output", relu(part)) for name, part in zip(names, hidden, strict=True)}


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
