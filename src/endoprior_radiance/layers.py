"""Linear layers whose first weights come from a given generator, never from the global one."""

from __future__ import annotations

import math
from typing import TypeVar

import torch
from torch import Generator, Tensor, nn


class Linear(nn.Linear):
    """A linear layer that is made without values; `start` gives torch's usual ones."""

    def __init__(self, inputs: int, outputs: int) -> None:
        nn.Module.__init__(self)
        self.in_features, self.out_features = inputs, outputs
        self.weight = nn.Parameter(torch.empty(outputs, inputs))
        self.bias = nn.Parameter(torch.empty(outputs))

    def start(self, generator: Generator) -> None:
        """Weights and biases uniform within 1 / sqrt(inputs): torch's own start of a linear layer."""
        _uniform(self.weight, self.bias, self.in_features, generator)


class NormedLinear(nn.Module):
    """A linear layer whose rows have a length and a direction of their own (weight normalization)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.inputs, self.outputs = inputs, outputs
        self.direction = nn.Parameter(torch.empty(outputs, inputs))
        self.length = nn.Parameter(torch.empty(outputs, 1))
        self.bias = nn.Parameter(torch.empty(outputs))

    @property
    def weight(self) -> Tensor:
        """(outputs, inputs) rows of `length` along `direction`."""
        return self.direction * (self.length / self.direction.norm(dim=1, keepdim=True))

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return nn.functional.linear(x, self.weight, self.bias)

    def start(self, generator: Generator) -> None:
        """As `Linear.start`."""
        _uniform(self.direction, self.bias, self.inputs, generator)
        self.measure()

    @torch.no_grad()
    def measure(self) -> None:
        """Make `weight` what `direction` is now."""
        self.length.copy_(self.direction.norm(dim=1, keepdim=True))


def start(network: nn.Module, generator: Generator) -> None:
    """Give every layer its first values."""
    for layer in network.modules():
        if isinstance(layer, Linear | NormedLinear):
            layer.start(generator)


Layer = TypeVar("Layer", bound=nn.Module)


def layers_of(network: nn.Module, kind: type[Layer]) -> list[Layer]:
    """The layers of a kind in a network, in the order in which it was built."""
    return [layer for layer in network.modules() if isinstance(layer, kind)]


@torch.no_grad()
def _uniform(weight: Tensor, bias: Tensor, inputs: int, generator: Generator) -> None:
    bound = 1 / math.sqrt(inputs)
    for value in (weight, bias):
        value.uniform_(-bound, bound, generator=generator)
