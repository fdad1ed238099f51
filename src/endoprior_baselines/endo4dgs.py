"""Endo-4DGS: a small HexPlane field, and confidence in depth. Huang et al., MICCAI 2024.

As released. What differs from the release, and why, is in docs/methods.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize
from typing_extensions import override

from endoprior.core.config import Config
from endoprior.core.types import Frame, RenderOutput, Splats
from endoprior.initialization.first_gaussians import FirstGaussians, resting_spheres
from endoprior.model.gaussians import SH_C0, Gaussians
from endoprior.model.hexplane_field import HexPlaneField, HexPlaneMotion
from endoprior.render.projection import rotation_matrices
from endoprior.training.density import CLONE_EXTENT, MAX_GAUSSIANS, DensityStats, Plan
from endoprior.training.gaussian_hooks import in_epochs
from endoprior.training.losses import total_variation
from endoprior.training.ops import TrainingOps
from endoprior.training.optimizer import Rate, rate_of
from endoprior.training.state import ForwardPass
from endoprior.training.trainer import Stage

from .plane_terms import PlaneWeights, planes_of
from .released import Released, grid_points

EVERY_PX = 2
"""A point starts at every second pixel along both axes; the release takes all, a quarter of a million."""
DEPTH_WEIGHT, GRADIENT_WEIGHT, NORMAL_WEIGHT, CONFIDENCE_WEIGHT, TV_WEIGHT = 0.01, 0.01, 0.001, 0.001, 0.01
PLANES = PlaneWeights(space=1e-4, time=0.01, ones=1e-4)
GROW_BELOW, REMOVE_ABOVE = 360_000, 200_000
"""Gaussians are added only while there are fewer, and removed only while there are more."""

DEPTH_EPSILON = 1e-6
VARIANCE_EPSILON = 1e-12
"""Keeps the gradient of a correlation finite where a depth is flat."""
MIN_CONFIDENCE = 1e-6
"""Confidence is at least this: its logarithm counts."""


class SmallField(HexPlaneField):
    """A wider network, and a box that stays."""

    width = 64
    learns_box = False


class SmallMotion(HexPlaneMotion):
    """See `SmallField`."""

    field_class = SmallField


class Endo4DGS(Released):
    """See `GaussianMethod`."""

    first_share = 1 / EVERY_PX**2
    name = "endo4dgs"
    way = SmallMotion()
    changes: ClassVar[Mapping[str, Any]] = {
        "deformation.hexplane.time_resolution": 75,
        "deformation.hexplane.channels": 32,
        "deformation.hexplane.multires": (1, 2),
        "render.depth_grad_to_means": True,
        "density.stop_iteration": 1500,
        "optim.decay_iterations": 20_000,
        "schedule.sh_every": 1000,
    }

    @override
    def first_gaussians(self, frames: Sequence[Frame], cfg: Config) -> FirstGaussians:
        return resting_spheres(grid_points(frames[:1], EVERY_PX, 0), cfg.init.opacity)

    @override
    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        """Without a spatial factor."""
        return rate_of(name, cfg, 1.0)

    @override
    def position(self, cfg: Config, stage: Stage, iteration: int, num_frames: int, rng: np.random.Generator) -> int:
        return in_epochs(cfg.seed, stage, iteration, num_frames)

    @override
    def terms(self, forward: ForwardPass, cfg: Config, ops: TrainingOps) -> dict[str, Tensor]:
        frame, out = forward.frame, forward.out
        mask, color = frame.tissue_mask[..., None], out.color * frame.tissue_mask[..., None]
        z = out.depth / out.alpha.clamp(min=MIN_CONFIDENCE)
        known, valid = frame.depth, frame.measured & (z > 0)
        depth, target = without_scale(z, valid), without_scale(known, valid)
        facing = (rendered_normals(forward.splats, forward.render) * normals_of_depth(known)).sum(-1)
        trust = out.alpha.detach()
        picture = confident_error(out.color[frame.tissue_mask], frame.rgb[frame.tissue_mask], trust[frame.tissue_mask])
        surface = confident_error(depth[valid][:, None], target[valid][:, None], trust[valid])
        terms = {
            "color": ((color - frame.rgb) * mask).abs().mean(),
            "depth": DEPTH_WEIGHT * (depth - target).abs().mean(),
            "gradient": GRADIENT_WEIGHT * gradient_correlation(z, known, valid),
            "normal": NORMAL_WEIGHT * ((1 - facing) * frame.measured).abs().mean(),
            "confidence": CONFIDENCE_WEIGHT * picture + CONFIDENCE_WEIGHT * surface,
        }
        if forward.stage is Stage.FINE:
            terms["tv"] = TV_WEIGHT * (total_variation(color) + total_variation(z * frame.tissue_mask))
        return terms | planes_of(forward, PLANES)

    @override
    def plan(
        self, stats: DensityStats, gaussians: Gaussians, extent: float, stage: Stage, iteration: int, cfg: Config
    ) -> Plan:
        gradient, num = stats.grad2d_ndc_sum / stats.num_seen.clamp(min=1), len(gaussians)
        grow = gradient >= cfg.density.grow_threshold
        grow &= num + int(grow.sum()) <= MAX_GAUSSIANS and num < GROW_BELOW
        small = gaussians.scales.amax(-1) <= CLONE_EXTENT * extent
        remove = (gaussians.opacities < cfg.density.prune_opacity) & (num > REMOVE_ABOVE)
        split = grow & ~small
        return Plan(clone=grow & small & ~remove, split=split, remove=remove & ~split, removed_by={"opacity": remove})


def without_scale(depth: Tensor, counted: Tensor) -> Tensor:
    """Depth (H, W) where it counts (bool), else 0, divided by the largest there, which carries a gradient."""
    depth = depth * counted
    return depth / (depth.max() + DEPTH_EPSILON)


def gradient_correlation(depth: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """1 - Pearson's correlation of the squared gradients (dx^2 + dy^2) of two depths (H, W), ().

    A gradient counts where the pixel, the next one and the one below are `valid` (H, W).
    """
    counted = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1]
    if int(counted.sum()) < 2:
        return depth.sum() * 0
    a, b = (_squared_gradient(values)[counted] for values in (depth, target))
    a, b = a - a.mean(), b - b.mean()
    return 1 - (a * b).sum() / (a.square().sum() * b.square().sum() + VARIANCE_EPSILON).sqrt()


def _squared_gradient(depth: Tensor) -> Tensor:
    across, down = depth[:-1, 1:] - depth[:-1, :-1], depth[1:, :-1] - depth[:-1, :-1]
    return across**2 + down**2


def normals_of_depth(depth: Tensor) -> Tensor:
    """(H, W, 3) unit vectors along (dx, -dy, -1) of a depth (H, W); the last row and column repeat those before."""
    across, down = depth[:-1, 1:] - depth[:-1, :-1], depth[1:, :-1] - depth[:-1, :-1]
    found = normalize(torch.stack([across, -down, -torch.ones_like(across)], -1), dim=-1)
    found = torch.cat([found, found[-1:]], 0)
    return torch.cat([found, found[:, -1:]], 1)


def smallest_axes(splats: Splats) -> Tensor:
    """(N, 3) the axis of each Gaussian along which it is thinnest, in world axes."""
    axes = rotation_matrices(splats.quats).transpose(1, 2)
    return axes[torch.arange(len(axes), device=axes.device), splats.scales.argmin(1)]


def rendered_normals(splats: Splats, render: Callable[[Splats], RenderOutput]) -> Tensor:
    """(H, W, 3) the thinnest axes n rendered as colors (n + 1) / 2; color of higher degrees stays in, as released."""
    first = (((smallest_axes(splats) + 1) / 2 - 0.5) / SH_C0)[:, None]
    return render(replace(splats, sh=torch.cat([first, splats.sh[:, 1:]], 1), color_slopes=None)).color


def confident_error(value: Tensor, target: Tensor, confidence: Tensor) -> Tensor:
    """MSE / mean(2 c^2) + mean log c, () of values (P, C) with confidence c (P,); 0 without pixels."""
    if not len(value):
        return value.sum()
    c = confidence.clamp(min=MIN_CONFIDENCE)
    return (value - target).square().mean() / (2 * c.square()).mean() + c.log().mean()


METHOD = Endo4DGS()
