"""The small network that predicts offsets from a feature: one shared linear trunk, one head per attribute.

trunk: linear F -> W. Head: ReLU, linear W -> W, ReLU, linear W -> outputs (EndoGaussian). Weights start Xavier
uniform, so the offsets are not zero at the start.
"""

from __future__ import annotations

import math
from copy import copy
from typing import Literal, Self

import torch
from torch import Tensor
from torch.nn.functional import linear, relu
from torch.nn.init import xavier_uniform_

from .ops import ModelOps


class LinearLayers:
    """Linear layers by name; `parameters` names every trained tensor. The layer `trunk` reads a field's features."""

    def __init__(
        self, shapes: dict[str, tuple[int, int]], bias_init: Literal["default", "zero"], generator: torch.Generator
    ) -> None:
        """Draw the weights from `generator`.

        Args:
            shapes: outputs and inputs of each layer by name.
            bias_init: `default` draws biases from U[-1, 1] / sqrt(inputs) as PyTorch does; `zero` sets them to 0.
        """
        self.parameters: dict[str, Tensor] = {}
        for layer, (fan_out, fan_in) in shapes.items():
            weight, bias = torch.empty(fan_out, fan_in), torch.zeros(fan_out)
            xavier_uniform_(weight, generator=generator)
            if bias_init == "default":
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
        outputs: what to predict and how many numbers of each, as `attributes.offset_widths` gives them.
    """
    shapes = {"trunk": (width, num_features)}
    for name, num in outputs.items():
        shapes |= {f"{name}.hidden": (width, width), f"{name}.output": (num, width)}
    return shapes


class OffsetHeads(LinearLayers):
    """Trunk and heads."""

    def __init__(
        self,
        num_features: int,
        width: int,
        outputs: dict[str, int],
        bias_init: Literal["default", "zero"],
        generator: torch.Generator,
    ) -> None:
        """Args: as those of `head_shapes` and `LinearLayers`."""
        self.outputs = tuple(outputs)
        super().__init__(head_shapes(num_features, width, outputs), bias_init, generator)

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
