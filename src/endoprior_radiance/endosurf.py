"""EndoSurf (Zha et al., MICCAI 2023): a surface as the zero of a signed distance, which a deformation brings to a time.

The scene lies in the unit sphere: positions are (x - center) / radius. Distances along a ray of unit direction are s in
that unit, so depth is s * radius * (z of the direction). The release takes s for z, which is a little more off axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor, nn
from torch.nn.functional import linear, normalize, softplus
from typing_extensions import override

from endoprior.compute.frequency_encoding import encoded, encoded_size
from endoprior.compute.neighbors import nearest
from endoprior.compute.relu_network import BLOCK_ROWS
from endoprior.core.geometry import back_project, pixel_centers

from .field import RadianceField, RayBatch, uniform
from .layers import NormedLinear, layers_of, start
from .presets import RadianceConfig
from .rays import (
    Composited,
    RayFrames,
    Rays,
    by_weight,
    centers,
    composited,
    even,
    sphere_ends,
    surface_alpha,
    surface_places,
)

ROUNDS = 4
"""Rounds in which samples are added where the surface seems to be, ..."""
FIRST_SHARPNESS = 64.0
"""... as if its sharpness were this, twice as much in each round."""
BESIDE = 0.1
"""Side of the cube around a surface point in which its neighbor lies."""
WARM_UP, LAST_RATE, ANNEALED = 0.05, 0.05, 0.5
"""Share of the schedule over which the rate rises, the factor it then falls to, and the share that anneals alpha."""

COLOR_WEIGHT, DEPTH_WEIGHT, SURFACE_WEIGHT = 1.0, 1.0, 1.0
ANGLE_WEIGHT, EIKONAL_WEIGHT, NEIGHBOR_WEIGHT = 0.1, 0.1, 0.1
"""Weights of the terms."""
EIKONAL_WITHIN = 1.2
"""Samples within this radius count for the length of the gradient."""
STEPS, SECANT_STEPS = 128, 8
"""In which the first crossing of the surface is looked for, and then refined."""
SHARE = 0.005
"""Share of the measured pixels of a frame that are taken, ..."""
MIN_PIXELS = 100
"""... but at least about so many: a sphere around a few points of a small frame would miss most of the tissue."""
LOW, HIGH = 3.0, 99.9
"""Percentiles of all measured depths between which a point counts: edges of tools are often measured too near."""
NEIGHBORS, SPREAD = 5, 20.0
"""A point stays if this many others lie within so many times the mean distance to the nearest one."""
FILLED = 0.8
"""Distance of the farthest point from the center, as a share of the radius."""


DEFORMED, TIME, SURFACE, COLORED, DIRECTION = 6, 6, 6, 10, 4
"""Frequencies: position and time of the deformation, position of the distance, position and direction of the color."""
LAYERS, WIDTH, SKIP = 9, 256, 4
"""Layers of each network, their width, and the one that gets the input again."""
SPHERE = 0.8
"""Radius of the sphere that the surface starts as; the scene has radius 1."""
SHARPNESS = 0.3
"""First value of the parameter whose exponential, times 10, is the sharpness."""


def encoded_change(x: Tensor, dx: Tensor, num: int) -> Tensor:
    """How `encoded(x)` changes when x changes along `dx` (..., D): its directional derivative."""
    parts = [dx]
    for k in range(num):
        angle, rate = x * 2.0**k, dx * 2.0**k
        parts += [torch.cos(angle) * rate, -torch.sin(angle) * rate]
    return torch.cat(parts, -1)


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


@dataclass(frozen=True)
class Probed:
    """The networks at `P` points."""

    distance: Tensor
    """(P,)."""
    slope: Tensor
    """(P,) change of the distance along the ray, at the points' own time."""
    color: Tensor
    """(P, 3)."""
    gradient: Tensor | None
    """(P, 3) of the distance at the points' own time; None in rendering, where nothing needs it."""


class EndoSurf(RadianceField):
    """See the module."""

    only_measured = True
    center_mm: Tensor
    radius_mm: Tensor
    anneal: Tensor

    def __init__(self, cfg: RadianceConfig) -> None:
        super().__init__(cfg)
        self.deformation, self.surface, self.color = DeformationNetwork(), SurfaceNetwork(), ColorNetwork()
        self.sharpness = torch.nn.Parameter(torch.empty(()))
        self.register_buffer("center_mm", torch.empty(3))
        self.register_buffer("radius_mm", torch.empty(()))
        self.register_buffer("anneal", torch.empty(()))

    @torch.no_grad()
    @override
    def start(self, frames: RayFrames, generator: Generator) -> None:
        center, radius = enclosing_sphere(frames)
        self.center_mm.copy_(torch.from_numpy(center))
        self.radius_mm.fill_(radius)
        self.anneal.zero_()
        self.sharpness.fill_(SHARPNESS)
        for network in (self.deformation, self.surface, self.color):
            network.start(generator)

    @staticmethod
    @override
    def rate(share: float) -> float:
        """A linear rise, then half a cosine."""
        if share < WARM_UP:
            return share / WARM_UP
        done = (share - WARM_UP) / (1 - WARM_UP)
        return LAST_RATE + (1 - LAST_RATE) * (1 + math.cos(math.pi * done)) / 2

    @override
    def losses(self, batch: RayBatch, share: float, rng: np.random.Generator) -> dict[str, Tensor]:
        self.anneal.fill_(min(1.0, share / ANNEALED))
        origins, units = self._in_sphere(batch.rays)
        shift = uniform(rng, len(batch.rays), 1, device=self.device) - 0.5
        view, probed, points = self._view(origins, units, batch.time, shift)
        per_depth = batch.rays.lengths / self.radius_mm  # s per mm of depth
        target = batch.depth * per_depth
        there = origins + target[:, None] * units
        counted = batch.measured & (there.norm(dim=-1) < 1)
        distance, gradient = self.distance_and_gradient(there, batch.time)
        terms = {"color": self.color_term(view.color, batch.color), "depth": depth_term(view.depth, target, counted)}
        terms |= surface_terms(distance, (gradient * units).sum(-1), counted)
        assert probed.gradient is not None
        terms["eikonal"] = eikonal_term(probed.gradient, points.norm(dim=-1))
        found = first_crossing(lambda at: self.distance(at, batch.time), origins, units)
        beside = found + BESIDE * (uniform(rng, len(batch.rays), 3, device=self.device)[: len(found)] - 0.5)
        _, gradients = self.distance_and_gradient(torch.cat([found, beside]), batch.time)
        terms["neighbor"] = neighbor_term(gradients[: len(found)], gradients[len(found) :])
        return terms

    @override
    @staticmethod
    def color_term(color: Tensor, target: Tensor) -> Tensor:
        """Mean over rays of the sum over channels of absolute errors (N, 3)."""
        return COLOR_WEIGHT * (color - target).abs().sum() / len(color)

    @override
    def render(self, rays: Rays, time: float) -> Composited:
        origins, units = self._in_sphere(rays)
        with torch.no_grad():
            view, _, _ = self._view(origins, units, time, None)
        return Composited(view.color, view.depth * self.radius_mm / rays.lengths, view.alpha, view.weights)

    def _in_sphere(self, rays: Rays) -> tuple[Tensor, Tensor]:
        return (rays.origins - self.center_mm) / self.radius_mm, rays.units

    def _view(
        self, origins: Tensor, units: Tensor, time: float, shift: Tensor | None
    ) -> tuple[Composited, Probed, Tensor]:
        """What rays show, depth as s; the networks at the samples, and where those are (P, 3).

        `shift` (N, 1) in [-0.5, 0.5) moves all samples of a ray, in steps.
        """
        step = 2 / self.cfg.even_samples
        with torch.no_grad():
            s = self._samples(origins, units, time, 0 if shift is None else shift * step)
            steps = torch.cat([s[:, 1:] - s[:, :-1], torch.full_like(s[:, :1], step)], -1)
            middles = s + steps / 2
            points = (origins[:, None] + middles[..., None] * units[:, None]).flatten(0, 1)
        directions = units.repeat_interleave(s.shape[1], 0)
        probed = self.probe(points, directions, time)
        sharpness = torch.exp(10 * self.sharpness)
        distance, slope = (each.view_as(s) for each in (probed.distance, probed.slope))
        alpha = surface_alpha(distance, slope, steps, sharpness, float(self.anneal))
        return composited(alpha, probed.color.unflatten(0, s.shape), middles), probed, points

    def _samples(self, origins: Tensor, units: Tensor, time: float, shift: Tensor | float) -> Tensor:
        """(N, S) ascending s: even ones within the sphere, then rounds where the surface seems to be."""
        near, far = sphere_ends(origins, units)
        s = even(near, far, self.cfg.even_samples) + shift

        def at(s: Tensor) -> tuple[Tensor, Tensor]:
            points = (origins[:, None] + s[..., None] * units[:, None]).flatten(0, 1)
            return self.distance(points, time).view_as(s), (points.norm(dim=-1) < 1).view_as(s)

        distance, inside = at(s)
        for k, num in enumerate(rounds_of(self.cfg.more_samples)):
            weights = surface_places(s, distance, inside, FIRST_SHARPNESS * 2**k)
            more = by_weight(s, weights, centers(num, len(s), s.device))
            known = at(more) if k < ROUNDS - 1 else (torch.zeros_like(more), torch.zeros_like(more, dtype=torch.bool))
            s, order = torch.cat([s, more], -1).sort(-1)
            distance = torch.cat([distance, known[0]], -1).gather(-1, order)
            inside = torch.cat([inside, known[1]], -1).gather(-1, order)
        return s

    @torch.no_grad()
    def distance(self, points: Tensor, time: float) -> Tensor:
        """(P,) signed distance at points (P, 3) of the sphere, without gradient; in blocks, which fit into a cache."""
        blocks = points.split(BLOCK_ROWS)
        return torch.cat([self.surface(block + self.deformation(block, time))[0] for block in blocks])

    def distance_and_gradient(self, points: Tensor, time: float) -> tuple[Tensor, Tensor]:
        """(P,) signed distance and (P, 3) its gradient at the points' own time."""
        with torch.enable_grad():
            points = points.detach().requires_grad_()
            distance, _ = self.surface(points + self.deformation(points, time))
            return distance, self._gradient(distance.sum(), points)

    def probe(self, points: Tensor, directions: Tensor, time: float) -> Probed:
        """All networks at points (P, 3) that rays of unit directions (P, 3) pass."""
        trained = torch.is_grad_enabled()
        points = points.detach().requires_grad_(trained)
        moved, change = self.deformation.with_change(points, time, directions)
        with torch.enable_grad():
            canonical = (points + moved).requires_grad_()
            distance, features = self.surface(canonical)
            normals = self._gradient(distance.sum(), canonical, keep=trained, create=trained)
            gradient = self._gradient(canonical, points, normals) if trained else None
        along = directions + change
        slope = (normals * along).sum(-1)
        along = along / (along.norm(dim=-1, keepdim=True) + 1e-10)
        return Probed(distance, slope, self.color(canonical, normals, along, features), gradient)

    @staticmethod
    def _gradient(
        value: Tensor, of: Tensor, times: Tensor | None = None, *, keep: bool = True, create: bool = True
    ) -> Tensor:
        return torch.autograd.grad(value, of, times, retain_graph=keep, create_graph=create)[0]

    @override
    def wrong_values(self) -> str:
        sound = bool(self.radius_mm > 0) and 0 <= float(self.anneal) <= 1
        return "" if sound else "a positive number in radius_mm and 0 to 1 in anneal"


def rounds_of(num: int) -> list[int]:
    """Samples that each round adds: equal numbers, the rest in the last one."""
    each = num // ROUNDS
    return [each] * (ROUNDS - 1) + [num - each * (ROUNDS - 1)]


def depth_term(depth: Tensor, target: Tensor, counted: Tensor) -> Tensor:
    """Mean absolute error of depth (N,) over the rays that count."""
    return DEPTH_WEIGHT * _mean((depth - target).abs(), counted)


def surface_terms(distance: Tensor, slope: Tensor, counted: Tensor) -> dict[str, Tensor]:
    """At the measured points the signed distance (N,) is 0, and its change `slope` (N,) along the ray is below 0.

    The release sums the latter over all rays; those without depth have no point.
    """
    facing_away = _mean(torch.relu(slope), counted)
    return {"surface": SURFACE_WEIGHT * _mean(distance.abs(), counted), "angle": ANGLE_WEIGHT * facing_away}


def eikonal_term(gradients: Tensor, radii: Tensor) -> Tensor:
    """A distance changes by 1 per unit: mean of (|gradient| - 1)^2 over samples (P, 3) at small radii (P,)."""
    return EIKONAL_WEIGHT * _mean((gradients.norm(dim=-1) - 1).square(), radii < EIKONAL_WITHIN)


def neighbor_term(gradients: Tensor, others: Tensor) -> Tensor:
    """Mean distance between unit normals (P, 3) of surface points and of points beside them; 0 without any."""
    if not len(gradients):
        return gradients.sum()
    first, second = (normalize(each, dim=-1) for each in (gradients, others))
    return NEIGHBOR_WEIGHT * (first - second + 1e-12).norm(dim=-1).mean()


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    """Mean over those that count; 0 without any. What does not count may be anything, also not finite."""
    return torch.where(counted, values, torch.zeros_like(values)).sum() / counted.sum().clamp(min=1)


@torch.no_grad()
def first_crossing(distance: Callable[[Tensor], Tensor], origins: Tensor, units: Tensor) -> Tensor:
    """(K, 3) points at which K of N rays enter the surface: even steps within the unit sphere, then the secant method.

    `distance` gives (P,) of (P, 3).
    """
    s = even(*sphere_ends(origins, units), STEPS)
    points = origins[:, None] + s[..., None] * units[:, None]
    values = distance(points.flatten(0, 1)).view_as(s)
    enters = (values[:, :-1] > 0) & (values[:, 1:] <= 0)
    rows = enters.any(-1).nonzero()[:, 0]
    at = enters[rows].int().argmax(-1)
    low, high = s[rows, at], s[rows, at + 1]
    above, below = values[rows, at], values[rows, at + 1]
    middle = low
    for _ in range(SECANT_STEPS):
        middle = low + (high - low) * above / (above - below).clamp(min=1e-12)
        value = distance(origins[rows] + middle[:, None] * units[rows])
        outside = value > 0
        low, above = torch.where(outside, middle, low), torch.where(outside, value, above)
        high, below = torch.where(outside, high, middle), torch.where(outside, below, value)
    return origins[rows] + middle[:, None] * units[rows]


def enclosing_sphere(frames: RayFrames) -> tuple[NDArray[np.float64], float]:
    """Center (3,) in world axes and radius, mm."""
    ends = frames.depth_percentiles(LOW, HIGH, missing=False)
    points = without_outliers(np.concatenate([_points(frames, k, ends) for k in frames.usable]))
    center = (points.min(0) + points.max(0)) / 2
    radius = float(np.linalg.norm(points - center, axis=1).max()) / FILLED
    return center, radius or 1.0


def _points(frames: RayFrames, position: int, ends: tuple[float, float]) -> NDArray[np.float64]:
    """Evenly chosen measured points of a frame; a fixed choice, since nothing depends on which."""
    depth, camera = frames.depth(position), frames.frame(position).camera
    pixels = np.flatnonzero((depth > 0) & (depth >= ends[0]) & (depth <= ends[1]))
    chosen = pixels[:: max(1, min(int(1 / SHARE), len(pixels) // MIN_PIXELS))]
    at = pixel_centers(camera.width, camera.height).reshape(-1, 2)[chosen].astype(np.float64)
    return without_outliers(back_project(at, depth.ravel()[chosen].astype(np.float64), camera))


def without_outliers(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points (P, 3) that have neighbors; all of them if there are too few to tell, or if none would stay."""
    if len(points) <= NEIGHBORS:
        return points
    _, distance = nearest(np.ascontiguousarray(points), NEIGHBORS)
    stays = distance[:, -1] <= SPREAD * distance[:, 0].mean()
    return points[stays] if stays.any() else points
