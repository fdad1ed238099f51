"""EndoSurf's networks: deformation to a canonical space, signed distance there, color, and how sharp the surface is."""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import softplus

from .encoding import encoded, encoded_change, encoded_size
from .layers import NormedLinear

DEFORMED, TIME, SURFACE, COLORED, DIRECTION = 6, 6, 6, 10, 4
"""Frequencies: position and time of the deformation, position of the distance, position and direction of the color."""
LAYERS, WIDTH, SKIP = 9, 256, 4
"""Layers of each network, their width, and the one that gets the input again."""
SPHERE = 0.8
"""Radius of the sphere that the surface starts as; the scene has radius 1."""
SHARPNESS = 0.3
"""First value of the parameter whose exponential, times 10, is the sharpness."""


class DeformationNetwork(nn.Module):
    """Displacement of a point from its time to the canonical space. The layer before the skip makes room for it."""

    def __init__(self) -> None:
        super().__init__()
        inputs = encoded_size(3, DEFORMED) + encoded_size(1, TIME)
        into = [inputs] + [WIDTH] * (LAYERS - 1)
        out = [WIDTH - inputs if k + 1 == SKIP else WIDTH for k in range(LAYERS - 1)] + [3]
        self.layers = nn.ModuleList(map(NormedLinear, into, out))

    def start(self, generator: Generator) -> None:
        """First values: torch's usual ones."""
        for layer in self.layers:
            layer.start(generator)

    def forward(self, points: Tensor, time: float) -> Tensor:
        """(P, 3) displacements of points (P, 3) at `time` in [0, 1]."""
        return self.with_change(points, time, None)[0]

    def with_change(self, points: Tensor, time: float, along: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Displacements (P, 3), and how they change when the points move along `along` (P, 3): J along.

        The change runs through the layers beside the value: one pass instead of three backward ones for the whole J.
        """
        at_time = encoded(points.new_tensor([[time]]), TIME).expand(len(points), -1)
        inputs = torch.cat([encoded(points, DEFORMED), at_time], -1)
        hidden, change, first_change = inputs, None, None
        if along is not None:
            first_change = torch.cat([encoded_change(points, along, DEFORMED), torch.zeros_like(at_time)], -1)
            change = first_change
        for k, layer in enumerate(self.layers):
            weight = layer.weight
            if k == SKIP:
                hidden = torch.cat([hidden, inputs], -1) / math.sqrt(2)
                change = None if change is None else torch.cat([change, first_change], -1) / math.sqrt(2)
            hidden = nn.functional.linear(hidden, weight, layer.bias)
            change = None if change is None else nn.functional.linear(change, weight)
            if k < LAYERS - 1:
                change = None if change is None else change * (hidden > 0)
                hidden = torch.relu(hidden)
        return hidden, change


class SurfaceNetwork(nn.Module):
    """Signed distance to the canonical surface, positive on the camera's side, and features for the color."""

    def __init__(self) -> None:
        super().__init__()
        inputs = encoded_size(3, SURFACE)
        into = [inputs] + [WIDTH + (inputs if k == SKIP else 0) for k in range(1, LAYERS)]
        self.layers = nn.ModuleList(map(NormedLinear, into, [WIDTH] * (LAYERS - 1) + [1 + WIDTH]))

    @torch.no_grad()
    def start(self, generator: Generator) -> None:
        """First values that make the distance about |x| - `SPHERE` (geometric initialization of Atzmon and Lipman)."""
        for k, layer in enumerate(self.layers):
            rows, last = layer.direction, k == LAYERS - 1
            mean, spread = (math.sqrt(math.pi / layer.inputs), 1e-4) if last else (0.0, math.sqrt(2 / layer.outputs))
            rows.normal_(mean, spread, generator=generator)
            layer.bias.fill_(-SPHERE if last else 0.0)
            if k in (0, SKIP):  # of the encoding only the position itself counts at first
                rows[:, layer.inputs - encoded_size(3, SURFACE) + 3 :] = 0
            layer.measure()

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (P,) and features (P, 256) at canonical points (P, 3)."""
        inputs = encoded(points, SURFACE)
        hidden = inputs
        for k, layer in enumerate(self.layers):
            if k == SKIP:
                hidden = torch.cat([hidden, inputs], -1) / math.sqrt(2)
            hidden = layer(hidden)
            if k < LAYERS - 1:
                hidden = softplus(hidden, beta=100)
        return hidden[:, 0], hidden[:, 1:]


class ColorNetwork(nn.Module):
    """Color of a canonical point, seen from a canonical direction."""

    def __init__(self) -> None:
        super().__init__()
        inputs = encoded_size(3, COLORED) + 3 + encoded_size(3, DIRECTION) + WIDTH
        into = [inputs] + [WIDTH + (inputs if k == SKIP else 0) for k in range(1, LAYERS)]
        self.layers = nn.ModuleList(map(NormedLinear, into, [WIDTH] * (LAYERS - 1) + [3]))

    def start(self, generator: Generator) -> None:
        """First values: torch's usual ones."""
        for layer in self.layers:
            layer.start(generator)

    def forward(self, points: Tensor, normals: Tensor, directions: Tensor, features: Tensor) -> Tensor:
        """(P, 3) color in (0, 1). `normals` are gradients (P, 3) of the distance, of any length."""
        inputs = torch.cat([encoded(points, COLORED), normals, encoded(directions, DIRECTION), features], -1)
        hidden = inputs
        for k, layer in enumerate(self.layers):
            if k == SKIP:
                hidden = torch.cat([hidden, inputs], -1) / math.sqrt(2)
            hidden = layer(hidden)
            if k < LAYERS - 1:
                hidden = torch.relu(hidden)
        return torch.sigmoid(hidden)
