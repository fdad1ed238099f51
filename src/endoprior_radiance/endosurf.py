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
from torch import Generator, Tensor
from torch.nn.functional import normalize
from typing_extensions import override

from endoprior.compute.neighbors import nearest
from endoprior.compute.relu_network import BLOCK_ROWS
from endoprior.core.geometry import back_project, pixel_centers

from .endosurf_networks import SHARPNESS, ColorNetwork, DeformationNetwork, SurfaceNetwork
from .field import RadianceField, RayBatch, uniform
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

COLOR, DEPTH, SURFACE, ANGLE, EIKONAL, NEIGHBOR = 1.0, 1.0, 1.0, 0.1, 0.1, 0.1
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
        return COLOR * (color - target).abs().sum() / len(color)

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
    return DEPTH * _mean((depth - target).abs(), counted)


def surface_terms(distance: Tensor, slope: Tensor, counted: Tensor) -> dict[str, Tensor]:
    """At the measured points the signed distance (N,) is 0, and its change `slope` (N,) along the ray is below 0.

    The release sums the latter over all rays; those without depth have no point.
    """
    return {"surface": SURFACE * _mean(distance.abs(), counted), "angle": ANGLE * _mean(torch.relu(slope), counted)}


def eikonal_term(gradients: Tensor, radii: Tensor) -> Tensor:
    """A distance changes by 1 per unit: mean of (|gradient| - 1)^2 over samples (P, 3) at small radii (P,)."""
    return EIKONAL * _mean((gradients.norm(dim=-1) - 1).square(), radii < EIKONAL_WITHIN)


def neighbor_term(gradients: Tensor, others: Tensor) -> Tensor:
    """Mean distance between unit normals (P, 3) of surface points and of points beside them; 0 without any."""
    if not len(gradients):
        return gradients.sum()
    first, second = (normalize(each, dim=-1) for each in (gradients, others))
    return NEIGHBOR * (first - second + 1e-12).norm(dim=-1).mean()


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
