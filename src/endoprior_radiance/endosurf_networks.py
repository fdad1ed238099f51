"""EndoSurf's networks: deformation to a canonical space, signed distance there, color, and how sharp the surface is."""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import linear, softplus

from endoprior.compute.frequency_encoding import encoded, encoded_size

from .layers import NormedLinear, encoded_change, layers_of, start

DEFORMED, TIME, SURFACE, COLORED, DIRECTION = 6, 6, 6, 10, 4
"""Frequencies: position and time of the deformation, position of the distance, position and direction of the color."""
LAYERS, WIDTH, SKIP = 9, 256, 4
"""Layers of each network, their width, and the one that gets the input again."""
SPHERE = 0.8
"""Radius of the sphere that the surface starts as; the scene has radius 1."""
SHARPNESS = 0.3
"""First value of the parameter whose exponential, times 10, is the sharpness."""


class SkipNetwork(nn.Module):
    """Nine layers, the fifth of which gets the input again."""

    activation = staticmethod(torch.relu)

    def __init__(self, inputs: list[int], outputs: list[int]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(map(NormedLinear, inputs, outputs))

    def start(self, generator: Generator) -> None:
        """First values: torch's usual ones."""
        start(self, generator)

    def through(self, inputs: Tensor) -> Tensor:
        """The last layer's outputs (P, outputs) of inputs (P, inputs)."""
        hidden = inputs
        for k, layer in enumerate(layers_of(self, NormedLinear)):
            hidden = layer(_with_input(k, hidden, inputs))
            if k < LAYERS - 1:
                hidden = self.activation(hidden)
        return hidden


def _with_input(k: int, hidden: Tensor, inputs: Tensor) -> Tensor:
    return torch.cat([hidden, inputs], -1) / math.sqrt(2) if k == SKIP else hidden


def _sizes(inputs: int, outputs: int) -> tuple[list[int], list[int]]:
    into = [inputs] + [WIDTH + (inputs if k == SKIP else 0) for k in range(1, LAYERS)]
    return into, [WIDTH] * (LAYERS - 1) + [outputs]


class DeformationNetwork(SkipNetwork):
    """Displacement of a point from its time to the canonical space. The layer before the skip makes room for it."""

    def __init__(self) -> None:
        inputs = encoded_size(3, DEFORMED) + encoded_size(1, TIME)
        out = [WIDTH - inputs if k + 1 == SKIP else WIDTH for k in range(LAYERS - 1)] + [3]
        super().__init__([inputs] + [WIDTH] * (LAYERS - 1), out)

    def forward(self, points: Tensor, time: float) -> Tensor:
        """(P, 3) displacements of points (P, 3) at `time` in [0, 1]."""
        return self.through(torch.cat([encoded(points, DEFORMED), self._at(time, points)], -1))

    def with_change(self, points: Tensor, time: float, along: Tensor) -> tuple[Tensor, Tensor]:
        """Displacements (P, 3), and how they change when the points move along `along` (P, 3): J along.

        The change runs through the layers beside the value: one pass instead of three backward ones for the whole J.
        """
        at_time = self._at(time, points)
        inputs = hidden = torch.cat([encoded(points, DEFORMED), at_time], -1)
        first = change = torch.cat([encoded_change(points, along, DEFORMED), torch.zeros_like(at_time)], -1)
        for k, layer in enumerate(layers_of(self, NormedLinear)):
            weight = layer.weight
            hidden = linear(_with_input(k, hidden, inputs), weight, layer.bias)
            change = linear(_with_input(k, change, first), weight)
            if k < LAYERS - 1:
                change = change * (hidden > 0)
                hidden = torch.relu(hidden)
        return hidden, change

    @staticmethod
    def _at(time: float, points: Tensor) -> Tensor:
        return encoded(points.new_tensor([[time]]), TIME).expand(len(points), -1)


class SurfaceNetwork(SkipNetwork):
    """Signed distance to the canonical surface, positive on the camera's side, and features for the color."""

    def __init__(self) -> None:
        super().__init__(*_sizes(encoded_size(3, SURFACE), 1 + WIDTH))

    @staticmethod
    def activation(hidden: Tensor) -> Tensor:
        """Smooth, so that the distance has a gradient everywhere."""
        return softplus(hidden, beta=100)

    @torch.no_grad()
    def start(self, generator: Generator) -> None:
        """First values that make the distance about |x| - `SPHERE` (geometric initialization of Atzmon and Lipman)."""
        for k, layer in enumerate(layers_of(self, NormedLinear)):
            rows, last = layer.direction, k == LAYERS - 1
            mean, spread = (math.sqrt(math.pi / layer.inputs), 1e-4) if last else (0.0, math.sqrt(2 / layer.outputs))
            rows.normal_(mean, spread, generator=generator)
            layer.bias.fill_(-SPHERE if last else 0.0)
            if k in (0, SKIP):  # of the encoding only the position itself counts at first
                rows[:, layer.inputs - encoded_size(3, SURFACE) + 3 :] = 0
            layer.measure()

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (P,) and features (P, 256) at canonical points (P, 3)."""
        values = self.through(encoded(points, SURFACE))
        return values[:, 0], values[:, 1:]


class ColorNetwork(SkipNetwork):
    """Color of a canonical point, seen from a canonical direction."""

    def __init__(self) -> None:
        super().__init__(*_sizes(encoded_size(3, COLORED) + 3 + encoded_size(3, DIRECTION) + WIDTH, 3))

    def forward(self, points: Tensor, normals: Tensor, directions: Tensor, features: Tensor) -> Tensor:
        """(P, 3) color in (0, 1). `normals` are gradients (P, 3) of the distance, of any length."""
        inputs = torch.cat([encoded(points, COLORED), normals, encoded(directions, DIRECTION), features], -1)
        return torch.sigmoid(self.through(inputs))
