"""EndoNeRF (Wang et al., MICCAI 2022): density and color at time 0, and a network that takes points there.

Depth u is z over the spread of the measured depths (P99.9 - P3, missing ones counted as 0). The release's ray
parameter in normalized device coordinates is u / 2 for a static camera, which is what it was made for; see
`rays.to_perspective`, which gives moving cameras a meaning.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import huber_loss
from typing_extensions import override

from endoprior.compute.frequency_encoding import encoded, encoded_size
from endoprior.compute.relu_network import relu_network

from .field import RadianceField, RayBatch, normal, uniform
from .layers import Linear, layers_of, start
from .presets import RadianceConfig
from .rays import (
    Composited,
    RayFrames,
    Rays,
    by_weight,
    centers,
    composited,
    density_alpha,
    even,
    jittered,
    to_perspective,
    weights_of,
)

LOW, HIGH = 3.0, 99.9
"""Percentiles of depth whose difference is the unit of u."""
SIGMA = 1.0
"""Standard deviation of the first samples around measured depth, in units of the ray parameter u / 2."""
NEAR, FAR = 2e-6, 2.0
"""u between which a ray is sampled evenly where no depth is known, and always when a scene is rendered."""
NOISE = 1.0
"""Standard deviation of the noise on density in training: it keeps fog from being a cheap answer."""
DECAY, DECAY_SHARE = 0.1, 2.5
"""The rate falls by this factor in so many times the schedule: in 250,000 iterations of 100,000."""

POSITION, TIME, DIRECTION = 10, 10, 4
"""Frequencies of each input."""
LAYERS, WIDTH, SKIP = 8, 256, 5
"""Hidden layers, their width, and the one that gets the encoded position again."""
DEPTH_WEIGHT, HUBER_DELTA = 1.0, 0.2


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
        layers = [(layer.weight, layer.bias) for layer in layers_of(self, Linear)]
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
        """(P, 4) color in (0, 1), then density before its ReLU, at points (P, 3) seen along unit directions (P, 3)."""
        features = self.trunk(encoded(points, POSITION), self.feature, self.density)
        seen = torch.cat([features[:, :WIDTH], encoded(directions, DIRECTION)], -1)
        layers = [(layer.weight, layer.bias) for layer in (self.view, self.color)]
        return torch.cat([torch.sigmoid(relu_network(seen, layers)), features[:, WIDTH:]], -1)


class EndoNeRF(RadianceField):
    """See the module."""

    only_measured = False
    world_to_reference: Tensor
    slopes: Tensor
    scale_mm: Tensor

    def __init__(self, cfg: RadianceConfig) -> None:
        super().__init__(cfg)
        self.time, self.canonical = TimeNetwork(), CanonicalNetwork()
        self.register_buffer("world_to_reference", torch.empty(4, 4))
        self.register_buffer("slopes", torch.empty(2))
        self.register_buffer("scale_mm", torch.empty(()))

    @torch.no_grad()
    @override
    def start(self, frames: RayFrames, generator: Generator) -> None:
        camera = frames.camera
        self.world_to_reference.copy_(torch.from_numpy(camera.world_to_camera))
        self.slopes.copy_(torch.tensor([2 * camera.fx / camera.width, 2 * camera.fy / camera.height]))
        self.scale_mm.fill_(depth_spread(frames))
        start(self.time, generator)
        start(self.canonical, generator)

    @staticmethod
    @override
    def rate(share: float) -> float:
        return DECAY ** (share / DECAY_SHARE)

    @override
    def losses(self, batch: RayBatch, share: float, rng: np.random.Generator) -> dict[str, Tensor]:
        """Samples around measured depth, then more where density is."""
        target = batch.depth / self.scale_mm
        first = self.first_samples(target, batch.measured, rng)
        view = self.view(batch.rays, batch.time, first, rng)
        return loss_terms(view, batch.color, target, batch.measured)

    @override
    @staticmethod
    def color_term(color: Tensor, target: Tensor) -> Tensor:
        """Mean squared error over rays and channels (N, 3)."""
        return (color - target).square().mean()

    @torch.no_grad()
    @override
    def render(self, rays: Rays, time: float) -> Composited:
        view = self.view(rays, time, self._even(len(rays)), None)
        return Composited(view.color, view.depth * self.scale_mm, view.alpha, view.weights)

    def first_samples(self, target: Tensor, measured: Tensor, rng: np.random.Generator) -> Tensor:
        """(N, S) u in ascending order: around u / 2 = `target` (N,) where it is measured, else even; jittered.

        The center is the release's: twice the measured depth. The samples are so far apart that it hardly matters.
        """
        num, device = (len(target), self.cfg.even_samples), target.device
        around = 2 * (target[:, None] + SIGMA * normal(rng, *num, device=device)).sort(-1).values
        first = torch.where(measured[:, None], around, self._even(len(target)))
        return jittered(first, uniform(rng, *num, device=device))

    def _even(self, num: int) -> Tensor:
        ends = torch.ones(num, device=self.device)
        return even(NEAR * ends, FAR * ends, self.cfg.even_samples)

    def view(self, rays: Rays, time: float, first: Tensor, rng: np.random.Generator | None) -> Composited:
        """Rays with samples at u = `first` (N, S) and more where those are dense; depth in units of u.

        Every sample goes through the networks once; the release evaluates the first ones again among all. `rng` chooses
        places and adds noise to density; None does neither.
        """
        values = self._values(rays, time, first)
        with torch.no_grad():
            weights = weights_of(density_alpha(self._noisy(values[..., 3], rng), first))[:, 1:-1]
            edges = (first[:, 1:] + first[:, :-1]) / 2
            num = (len(rays), self.cfg.more_samples)
            places = centers(num[1], num[0], first.device) if rng is None else uniform(rng, *num, device=first.device)
            more = by_weight(edges, weights, places)
        u, order = torch.cat([first, more], -1).sort(-1)
        values = torch.cat([values, self._values(rays, time, more)], 1)
        values = values.gather(1, order[..., None].expand_as(values))
        return composited(density_alpha(self._noisy(values[..., 3], rng), u), values[..., :3], u)

    def _noisy(self, density: Tensor, rng: np.random.Generator | None) -> Tensor:
        return density if rng is None else density + NOISE * normal(rng, *density.shape, device=density.device)

    def _values(self, rays: Rays, time: float, u: Tensor) -> Tensor:
        """(N, S, 4) color and density before its ReLU, at u (N, S) of each ray."""
        turn, shift = self.world_to_reference[:3, :3], self.world_to_reference[:3, 3]
        points = to_perspective(rays.at(u * self.scale_mm) @ turn.T + shift, self.slopes, self.scale_mm).flatten(0, 1)
        directions = (rays.units @ turn.T).repeat_interleave(u.shape[1], 0)
        return self.canonical(points + self.time(points, time), directions).unflatten(0, u.shape)

    @override
    def wrong_values(self) -> str:
        positive = bool(self.scale_mm > 0) and bool((self.slopes > 0).all())
        return "" if positive else "positive numbers in scale_mm and slopes"


def depth_spread(frames: RayFrames) -> float:
    """P99.9 - P3 of the depths of all training frames, mm; missing ones count as 0, as in the release."""
    low, high = frames.depth_percentiles(LOW, HIGH, missing=True)
    return high - low or high or 1.0


def expected(view: Composited) -> Tensor:
    """(N,) depth over alpha, as the loss compares it: by way of its inverse, at most 1e6."""
    inverse = 1 / (view.depth / (view.alpha + 1e-6)).clamp(min=1e-10)
    return 1 / (inverse + 1e-6)


def loss_terms(view: Composited, color: Tensor, depth: Tensor, measured: Tensor) -> dict[str, Tensor]:
    """Weighted terms of color (N, 3), and of depth (N,) in the unit of the view's where it is measured.

    Without a depth, the release compares with 0, which its depth maps hold there; here such rays have color only.
    """
    apart = huber_loss(expected(view), depth, delta=HUBER_DELTA, reduction="none")
    share = torch.where(measured, apart, torch.zeros_like(apart)).sum() / measured.sum().clamp(min=1)
    return {"color": EndoNeRF.color_term(view.color, color), "depth": DEPTH_WEIGHT * share}
