"""EndoGS: a HexPlane field that moves everything, rays weighted by how often tools hide them. As released, 2024.

What differs from the release, and why, is in docs/methods.md. Terms of its loss that carry no gradient there (entropy
of opacities, signed distance, normals) are left out.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, huber_loss

from endoprior.core.config import Config
from endoprior.model.gaussians import Gaussians
from endoprior.model.motion import Motion
from endoprior.model.presets import paper
from endoprior.training.density import CLONE_EXTENT, MAX_GAUSSIANS, DensityStats, Plan
from endoprior.training.frames import TrainingFrames
from endoprior.training.gaussian_method import GaussianMethod, in_epochs
from endoprior.training.losses import total_variation
from endoprior.training.ops import TrainingOps
from endoprior.training.optimizer import PLANES, Rate, log_linear, rate_of
from endoprior.training.step import Drawn
from endoprior.training.trainer import Stage

from .endogs_field import UNIT_MM, JointMotion
from .plane_terms import PlaneWeights, plane_term

SPATIAL_SCALE = 5.0
"""Factor of the rates of centers, network and planes; also the extent, in its unit, that parts clones from splits."""
EXTENT_MM = SPATIAL_SCALE * UNIT_MM
SHORTER = 10
"""By how much the schedule is shorter than the published one, and the rates of network and planes are higher."""
NETWORK_RATE, PLANES_RATE = SHORTER * 1.5e-5, SHORTER * 1.5e-4
OFTEN_HIDDEN = 30.0
"""How much more a ray counts that a tool often hides."""
DEPTH_WEIGHT, HUBER_DELTA, DEPTH_EPSILON = 0.5, 0.2, 1e-5
TV_WEIGHT = 0.01
PLANE_WEIGHTS = PlaneWeights(space=1e-3, time=1e-3, ones=2e-2)
PRUNE_EVERY, RESET_EVERY, FIRST_RESET = 7000, 6000, 500
MOST_SCALE_SHARE = 0.1
"""After the opacity reset at 6,000 larger Gaussians go; share of the extent.

As in `surgicalgaussian`, the radius of 20 px that the release also names is left out.
"""


class EndoGS(GaussianMethod):
    """See `GaussianMethod`."""

    background = (1.0, 1.0, 1.0)
    uses_prior = False
    keeps_optimizer = True
    _motion = JointMotion()

    def config(self) -> Config:
        """What its preset starts from. Published: 3,000 and 60,000 iterations."""
        return paper().replace(
            {
                "method": "endogs",
                "init.sampler": "pool",
                "deformation.hexplane.time_resolution": 75,
                "deformation.hexplane.channels": 32,
                "temporal.weight": 0.0,
                "density.stop_iteration": 45_000,
                "density.min_densify_weight": 1.0,
                "optim.decay_iterations": 1_000_000,
                "schedule.fine_iterations": 5000,
                "schedule.sh_every": 1000,
            }
        )

    def motion(self, cfg: Config) -> Motion:
        """See `Method.motion`."""
        return self._motion

    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        """See `GaussianMethod.rate`."""
        if name != "box" and name != PLANES and not name.startswith("network"):
            return rate_of(name, cfg, EXTENT_MM)
        scale, start = EXTENT_MM if name == "box" else SPATIAL_SCALE, PLANES_RATE
        if name.startswith("network"):
            start = NETWORK_RATE
        return lambda iteration: scale * log_linear(start, start, iteration, cfg.optim.decay_iterations)

    def position(self, seed: int, stage: Stage, iteration: int, num_frames: int, rng: np.random.Generator) -> int:
        """See `GaussianMethod.position`."""
        return in_epochs(seed, stage, iteration, num_frames)

    def context(self, frames: TrainingFrames, cfg: Config) -> Tensor:
        """(H, W) 1 + 30 F / ||F||, F the number of frames in which a tool hides the pixel."""
        hidden = sum((~frames.frame(i).tissue_mask).float() for i in range(len(frames)))
        norm = hidden.norm()
        return 1 + OFTEN_HIDDEN * (hidden / norm if norm else hidden)

    def terms(self, drawn: Drawn, cfg: Config, ops: TrainingOps) -> dict[str, Tensor]:
        """See `GaussianMethod.terms`."""
        frame, out = drawn.frame, drawn.out
        mask, weight = frame.tissue_mask[..., None], drawn.context
        if weight.shape != frame.tissue_mask.shape:  # at half resolution
            weight = adaptive_avg_pool2d(weight[None], frame.tissue_mask.shape)[0]
        terms = {
            "color": ((out.color - frame.rgb).abs() * mask * weight[..., None]).mean(),
            "depth": DEPTH_WEIGHT * depth_huber(out.depth, frame.depth, frame.measured),
            "tv": TV_WEIGHT * total_variation(out.color * ~mask),
        }
        if drawn.stage is Stage.FINE:
            anchor = next(iter(drawn.field.parameters.values()))
            terms["planes"] = plane_term(drawn.field.grid, PLANE_WEIGHTS, anchor)
        return terms

    def plan(
        self, stats: DensityStats, gaussians: Gaussians, extent: float, stage: Stage, iteration: int, cfg: Config
    ) -> Plan:
        """See `GaussianMethod.plan`: grow every time, prune seldom."""
        gradient, largest = stats.grad2d_ndc_sum / stats.num_seen.clamp(min=1), gaussians.scales.amax(-1)
        grow = gradient >= cfg.density.grow_threshold
        small = largest <= CLONE_EXTENT * EXTENT_MM
        faint = gaussians.opacities < cfg.density.prune_opacity
        large = (largest > MOST_SCALE_SHARE * EXTENT_MM) & (iteration > RESET_EVERY)
        remove = (faint | large) & (iteration % PRUNE_EVERY == 0)
        if len(grow) + int(grow.sum()) > MAX_GAUSSIANS:
            grow = torch.zeros_like(grow)
        split = grow & ~small
        rules = {"opacity": faint, "size": large}
        return Plan(clone=grow & small & ~remove, split=split, remove=remove & ~split, removed_by=rules)

    def reset_due(self, stage: Stage, iteration: int, cfg: Config) -> bool:
        """See `GaussianMethod.reset_due`; the first one belongs to the white background."""
        inside = iteration < cfg.density.stop_iteration
        return inside and (iteration == FIRST_RESET or iteration % RESET_EVERY == 0)


def depth_huber(depth: Tensor, target: Tensor, measured: Tensor) -> Tensor:
    """Huber loss, mean over all pixels, of depths that are each divided by the largest of their image.

    Args:
        depth, target: (H, W) mm; the largest value of each counts wherever it is; that of `depth` has a gradient.
        measured: (H, W) bool; other pixels are 0 on both sides.
    """
    scaled, wanted = (values / (values.max() + DEPTH_EPSILON) * measured for values in (depth, target))
    return huber_loss(scaled, wanted, delta=HUBER_DELTA)


METHOD = EndoGS()
