"""EndoNeRF's two networks: where a point was at time 0, and what is there."""

from __future__ import annotations

import torch
from torch import Generator, Tensor, nn

from endoprior.compute.relu_network import relu_network

from .encoding import encoded, encoded_size
from .layers import Linear

POSITION, TIME, DIRECTION = 10, 10, 4
"""Frequencies of each input."""
LAYERS, WIDTH, SKIP = 8, 256, 5
"""Hidden layers, their width, and the one that gets the encoded position again."""


class _Trunk(nn.Module):
    """Eight layers; the sixth gets the encoded position once more."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        position = encoded_size(3, POSITION)
        widths = [inputs] + [WIDTH + (position if k == SKIP else 0) for k in range(1, LAYERS)]
        self.layers = nn.ModuleList(Linear(width, WIDTH) for width in widths)

    def forward(self, inputs: Tensor, *heads: Linear) -> Tensor:
        """What linear `heads` make of the last layer, side by side. The encoded position comes first in `inputs`."""
        weight, bias = (torch.cat([getattr(head, name) for head in heads]) for name in ("weight", "bias"))
        layers = [(layer.weight, layer.bias) for layer in self.layers]
        return relu_network(inputs, [*layers, (weight, bias)], skip=SKIP, repeated=encoded_size(3, POSITION))


class TimeNetwork(nn.Module):
    """Displacement of a point from its time to time 0; exactly 0 at time 0."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = _Trunk(encoded_size(3, POSITION) + encoded_size(1, TIME))
        self.out = Linear(WIDTH, 3)

    def forward(self, points: Tensor, time: float) -> Tensor:
        """(P, 3) displacements of points (P, 3) at `time` in [0, 1]."""
        if time == 0:
            return torch.zeros_like(points)
        position = encoded(points, POSITION)
        at_time = encoded(points.new_tensor([[time]]), TIME).expand(len(points), -1)
        return self.trunk(torch.cat([position, at_time], -1), self.out)


class CanonicalNetwork(nn.Module):
    """Density and color at time 0."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = _Trunk(encoded_size(3, POSITION))
        self.density = Linear(WIDTH, 1)
        self.feature = Linear(WIDTH, WIDTH)
        self.view = Linear(WIDTH + encoded_size(3, DIRECTION), WIDTH // 2)
        self.color = Linear(WIDTH // 2, 3)

    def forward(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color in (0, 1), then density before its ReLU.

        Args:
            points: (P, 3) at time 0.
            directions: (P, 3) unit directions of the rays.
        Returns:
            (P, 4).
        """
        features = self.trunk(encoded(points, POSITION), self.feature, self.density)
        seen = torch.cat([features[:, :WIDTH], encoded(directions, DIRECTION)], -1)
        layers = [(layer.weight, layer.bias) for layer in (self.view, self.color)]
        return torch.cat([torch.sigmoid(relu_network(seen, layers)), features[:, WIDTH:]], -1)


def start(network: nn.Module, generator: Generator) -> None:
    """Give every layer its first values."""
    for layer in network.modules():
        if isinstance(layer, Linear):
            layer.start(generator)
