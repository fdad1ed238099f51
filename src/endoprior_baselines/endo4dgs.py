"""Endo-4DGS: a small HexPlane field, and terms that trust depth only as far as it can be. Huang et al., MICCAI 2024.

As released. What differs from the release, and why, is in docs/methods.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from endoprior.core.config import Config
from endoprior.core.types import Frame
from endoprior.initialization.first_gaussians import FirstGaussians, resting_spheres
from endoprior.model.gaussians import Gaussians
from endoprior.model.hexplane_field import HexPlaneField, HexPlaneMotion
from endoprior.model.motion import Motion
from endoprior.model.presets import paper
from endoprior.training.density import CLONE_EXTENT, MAX_GAUSSIANS, DensityStats, Plan
from endoprior.training.gaussian_method import GaussianMethod, in_epochs
from endoprior.training.losses import total_variation
from endoprior.training.ops import TrainingOps
from endoprior.training.optimizer import Rate, rate_of
from endoprior.training.step import Drawn
from endoprior.training.trainer import Stage

from .endo4dgs_terms import (
    confident_error,
    gradient_correlation,
    normal_picture,
    normals_of_depth,
    without_scale,
)
from .plane_terms import PlaneWeights, plane_term
from .surface_points import grid_points

EVERY_PX = 2
"""A point starts at every second pixel along both axes; the release takes all, a quarter of a million."""
DEPTH_WEIGHT, GRADIENT_WEIGHT, NORMAL_WEIGHT, CONFIDENCE_WEIGHT, TV_WEIGHT = 0.01, 0.01, 0.001, 0.001, 0.01
PLANES = PlaneWeights(space=1e-4, time=0.01, ones=1e-4)
GROW_BELOW, REMOVE_ABOVE = 360_000, 200_000
"""Gaussians are added only while there are fewer, and removed only while there are more."""


class SmallField(HexPlaneField):
    """A wider network, and a box that stays."""

    width = 64
    learns_box = False


class SmallMotion(HexPlaneMotion):
    """See `SmallField`."""

    field_class = SmallField


class Endo4DGS(GaussianMethod):
    """See `GaussianMethod`."""

    uses_prior = False
    first_share = 1 / EVERY_PX**2
    _motion = SmallMotion()

    def config(self) -> Config:
        """What its preset starts from."""
        return paper().replace(
            {
                "method": "endo4dgs",
                "deformation.hexplane.time_resolution": 75,
                "deformation.hexplane.channels": 32,
                "deformation.hexplane.multires": (1, 2),
                "temporal.weight": 0.0,
                "density.stop_iteration": 1500,
                "density.min_densify_weight": 1.0,
                "optim.decay_iterations": 20_000,
                "schedule.sh_every": 1000,
            }
        )

    def motion(self, cfg: Config) -> Motion:
        """See `Method.motion`."""
        return self._motion

    def first_gaussians(self, frames: Sequence[Frame], cfg: Config) -> FirstGaussians:
        """See `GaussianMethod.first_gaussians`."""
        return resting_spheres(grid_points(frames[:1], EVERY_PX, 0), cfg.init.opacity)

    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        """See `GaussianMethod.rate`: without a spatial factor."""
        return rate_of(name, cfg, 1.0)

    def position(self, seed: int, stage: Stage, iteration: int, num_frames: int, rng: np.random.Generator) -> int:
        """See `GaussianMethod.position`."""
        return in_epochs(seed, stage, iteration, num_frames)

    def terms(self, drawn: Drawn, cfg: Config, ops: TrainingOps) -> dict[str, Tensor]:
        """See `GaussianMethod.terms`."""
        frame, out = drawn.frame, drawn.out
        mask, color = frame.tissue_mask[..., None], out.color * frame.tissue_mask[..., None]
        known, valid = frame.depth, frame.measured & (out.depth > 0)
        depth, target = without_scale(out.depth, valid), without_scale(known, valid)
        facing = (normal_picture(drawn.splats, drawn.render) * normals_of_depth(known)).sum(-1)
        trust = out.alpha[frame.tissue_mask]
        picture = confident_error(out.color[frame.tissue_mask], frame.rgb[frame.tissue_mask], trust)
        surface = confident_error(depth[valid][:, None], target[valid][:, None], out.alpha[valid])
        terms = {
            "color": ((color - frame.rgb) * mask).abs().mean(),
            "depth": DEPTH_WEIGHT * (depth - target).abs().mean(),
            "gradient": GRADIENT_WEIGHT * gradient_correlation(out.depth, known, valid),
            "normal": NORMAL_WEIGHT * ((1 - facing) * frame.measured).abs().mean(),
            "confidence": CONFIDENCE_WEIGHT * picture + CONFIDENCE_WEIGHT * surface,
        }
        if drawn.stage is Stage.FINE:
            terms["tv"] = TV_WEIGHT * (total_variation(color) + total_variation(out.depth * frame.tissue_mask))
            anchor = next(iter(drawn.field.parameters.values()))
            terms["planes"] = plane_term(drawn.field.grid, PLANES, anchor)
        return terms

    def plan(
        self, stats: DensityStats, gaussians: Gaussians, extent: float, stage: Stage, iteration: int, cfg: Config
    ) -> Plan:
        """See `GaussianMethod.plan`."""
        gradient, num = stats.grad2d_ndc_sum / stats.num_seen.clamp(min=1), len(gaussians)
        grow = gradient >= cfg.density.grow_threshold
        grow &= num + int(grow.sum()) <= MAX_GAUSSIANS and num < GROW_BELOW
        small = gaussians.scales.amax(-1) <= CLONE_EXTENT * extent
        remove = (gaussians.opacities < cfg.density.prune_opacity) & (num > REMOVE_ABOVE)
        split = grow & ~small
        return Plan(clone=grow & small & ~remove, split=split, remove=remove & ~split, removed_by={"opacity": remove})


METHOD = Endo4DGS()
