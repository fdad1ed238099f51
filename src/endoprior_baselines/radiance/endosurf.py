"""EndoSurf (Zha et al., MICCAI 2023): a surface as the zero of a signed distance, which a deformation brings to a time.

The scene lies in the unit sphere: positions are (x - center) / radius. Distances along a ray of unit direction are s in
that unit, so depth is s * radius * (z of the direction). The release takes s for z, which is a little more off axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Generator, Tensor

from endoprior.compute.relu_network import BLOCK_ROWS

from . import endosurf_losses as loss
from .compositing import Composited, composited, surface_alpha
from .config import RadianceConfig
from .enclosing_sphere import enclosing_sphere
from .endosurf_networks import SHARPNESS, ColorNetwork, DeformationNetwork, SurfaceNetwork
from .field import RadianceField, RayBatch, uniform
from .frames import RayFrames
from .marching import first_crossing
from .rays import Rays
from .sampling import by_weight, centers, even, sphere_ends, surface_places

ROUNDS = 4
"""Rounds in which samples are added where the surface seems to be, ..."""
FIRST_SHARPNESS = 64.0
"""... as if its sharpness were this, twice as much in each round."""
BESIDE = 0.1
"""Side of the cube around a surface point in which its neighbor lies."""
WARM_UP, LAST_RATE, ANNEALED = 0.05, 0.05, 0.5
"""Share of the schedule over which the rate rises, the factor it then falls to, and the share that anneals alpha."""


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
    color_term = staticmethod(loss.color_term)

    def __init__(self, cfg: RadianceConfig) -> None:
        super().__init__(cfg)
        self.deformation, self.surface, self.color = DeformationNetwork(), SurfaceNetwork(), ColorNetwork()
        self.sharpness = torch.nn.Parameter(torch.empty(()))
        self.register_buffer("center_mm", torch.empty(3))
        self.register_buffer("radius_mm", torch.empty(()))
        self.register_buffer("anneal", torch.empty(()))

    @torch.no_grad()
    def start(self, frames: RayFrames, generator: Generator) -> None:
        """See `RadianceField.start`."""
        center, radius = enclosing_sphere(frames)
        self.center_mm.copy_(torch.from_numpy(center))
        self.radius_mm.fill_(radius)
        self.anneal.zero_()
        self.sharpness.fill_(SHARPNESS)
        for network in (self.deformation, self.surface, self.color):
            network.start(generator)

    @staticmethod
    def rate(share: float) -> float:
        """See `RadianceField.rate`: a linear rise, then half a cosine."""
        if share < WARM_UP:
            return share / WARM_UP
        done = (share - WARM_UP) / (1 - WARM_UP)
        return LAST_RATE + (1 - LAST_RATE) * (1 + math.cos(math.pi * done)) / 2

    def losses(self, batch: RayBatch, share: float, rng: np.random.Generator) -> dict[str, Tensor]:
        """See `RadianceField.losses`."""
        self.anneal.fill_(min(1.0, share / ANNEALED))
        origins, units = self._in_sphere(batch.rays)
        shift = uniform(rng, len(batch.rays), 1, device=self.device) - 0.5
        view, probed, points = self._view(origins, units, batch.time, shift)
        per_depth = batch.rays.lengths / self.radius_mm  # s per mm of depth
        target = batch.depth * per_depth
        there = origins + target[:, None] * units
        counted = batch.measured & (there.norm(dim=-1) < 1)
        distance, gradient = self.distance_and_gradient(there, batch.time)
        terms = {
            "color": loss.color_term(view.color, batch.color),
            "depth": loss.depth_term(view.depth, target, counted),
        }
        terms |= loss.surface_terms(distance, (gradient * units).sum(-1), counted)
        terms["eikonal"] = loss.eikonal_term(probed.gradient, points.norm(dim=-1))
        found = first_crossing(lambda at: self.distance(at, batch.time), origins, units)
        beside = found + BESIDE * (uniform(rng, len(batch.rays), 3, device=self.device)[: len(found)] - 0.5)
        _, gradients = self.distance_and_gradient(torch.cat([found, beside]), batch.time)
        terms["neighbor"] = loss.neighbor_term(gradients[: len(found)], gradients[len(found) :])
        return terms

    def render(self, rays: Rays, time: float) -> Composited:
        """See `RadianceField.render`."""
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

        Args:
            shift: (N, 1) in [-0.5, 0.5), how far all samples of a ray are moved, in steps; None: not at all.
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
        alpha = surface_alpha(
            *(each.view_as(s) for each in (probed.distance, probed.slope)), steps, sharpness, float(self.anneal)
        )
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
            return distance, self._gradient(distance.sum(), points)[0]

    def probe(self, points: Tensor, directions: Tensor, time: float) -> Probed:
        """All networks at points (P, 3) that rays of unit directions (P, 3) pass."""
        trained = torch.is_grad_enabled()
        points = points.detach().requires_grad_(trained)
        moved, change = self.deformation.with_change(points, time, directions)
        with torch.enable_grad():
            canonical = (points + moved).requires_grad_()
            distance, features = self.surface(canonical)
            (normals,) = self._gradient(distance.sum(), canonical, keep=trained, create=trained)
            gradient = self._gradient(canonical, points, normals)[0] if trained else None
        along = directions + change
        slope = (normals * along).sum(-1)
        along = along / (along.norm(dim=-1, keepdim=True) + 1e-10)
        return Probed(distance, slope, self.color(canonical, normals, along, features), gradient)

    @staticmethod
    def _gradient(
        value: Tensor, of: Tensor, times: Tensor | None = None, *, keep: bool = True, create: bool = True
    ) -> tuple[Tensor]:
        return torch.autograd.grad(value, of, times, retain_graph=keep, create_graph=create)

    def wrong_values(self) -> str:
        """See `RadianceField.wrong_values`."""
        sound = bool(self.radius_mm > 0) and 0 <= float(self.anneal) <= 1
        return "" if sound else "a positive number in radius_mm and 0 to 1 in anneal"


def rounds_of(num: int) -> list[int]:
    """Samples that each round adds: equal numbers, the rest in the last one."""
    each = num // ROUNDS
    return [each] * (ROUNDS - 1) + [num - each * (ROUNDS - 1)]
