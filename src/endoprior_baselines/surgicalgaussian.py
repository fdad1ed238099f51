"""SurgicalGaussian: a network moves the Gaussians, neighbors keep their distance. Xie et al., MICCAI 2024, as released.

Its unit of length is 100 mm, so thresholds and rates that are lengths are 100 times those of the release here. What
differs from the release, and why, is in docs/methods.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from endoprior.compute.neighbors import nearest
from endoprior.core.config import Config
from endoprior.core.types import Frame, Splats
from endoprior.initialization.first_gaussians import FirstGaussians, resting_spheres
from endoprior.model.gaussians import Gaussians
from endoprior.model.motion import Motion, Offsets
from endoprior.model.ops import ModelOps
from endoprior.model.presets import paper
from endoprior.training import density
from endoprior.training.density import DensityStats, Plan
from endoprior.training.gaussian_method import GaussianMethod, in_epochs
from endoprior.training.losses import total_variation
from endoprior.training.ops import TrainingOps
from endoprior.training.optimizer import FINAL_SHARE, NETWORK_LR, Rate, log_linear, rate_of
from endoprior.training.step import Drawn
from endoprior.training.trainer import Stage

from .surface_points import grid_points
from .surgicalgaussian_terms import covariances, distance_change, ssim
from .time_network import TimeNetwork, state_shapes

UNIT_MM = 100.0
"""Its unit of length."""
EVERY_PX, FIRST_PX = 3, 1
"""Points start at every third pixel, from the second one on, along both axes."""
COLOR_SHARE, TV_WEIGHT, DEPTH_WEIGHT = 0.8, 0.02, 0.001
DISTANCE_WEIGHT, SHAPE_WEIGHT, NUM_NEIGHBORS = 0.2, 40.0, 4
"""Weights of the sequence `cutting`; those of `pulling` are 0. The release asks for five neighbors and drops itself."""
RESET_EVERY, FIRST_RESET = 3000, 500
MOST_SCALE = 0.1
"""After the reset of opacities at 3,000 larger Gaussians go; units of length.

The release also names a radius of 20 px. In the code that it descends from radii are 0 whenever they are compared:
growth, just before, clears them (docs/log.md). So it is left out.
"""
SMALLEST_SCALE_MM = 1e-6
NETWORK_LATER = 4 / 3
"""The network's rate decays over this many times the iterations of the centers'."""


class NetworkMotion(Motion):
    """See `TimeNetwork`. Offsets of scales and rotations are added after activation, as released."""

    def field(self, points: Tensor, cfg: Config) -> TimeNetwork:
        """See `Motion.field`."""
        return TimeNetwork.fresh(torch.Generator().manual_seed(cfg.seed))

    def field_of(self, arrays: Mapping[str, Tensor], cfg: Config) -> TimeNetwork:
        """See `Motion.field_of`."""
        return TimeNetwork.of_arrays(arrays)

    def field_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.field_shapes`."""
        return state_shapes()

    def parameter_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.parameter_shapes`."""
        return {f"network.{name}": shape for name, shape in state_shapes().items()}

    def offsets(
        self,
        gaussians: Gaussians,
        field: TimeNetwork,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """See `Motion.offsets`. A scale that becomes negative counts as its absolute value: the covariance is equal."""
        rows = slice(None) if chosen is None else chosen
        means, quats, log_scales = (gaussians[name][rows] for name in ("means", "quats", "log_scales"))
        found = field(means.detach() / UNIT_MM, time)
        scales = (log_scales.exp() + UNIT_MM * found["scales"]).abs().clamp(min=SMALLEST_SCALE_MM)
        return Offsets(
            means=UNIT_MM * found["means"],
            log_scales=scales.log() - log_scales,
            quats=normalize(quats, dim=-1) + found["quats"] - quats,
        )


class SurgicalGaussian(GaussianMethod):
    """See `GaussianMethod`."""

    background = (1.0, 1.0, 1.0)
    uses_prior = False
    first_share = 1 / EVERY_PX**2
    _motion = NetworkMotion()

    def config(self) -> Config:
        """What its preset starts from. Published: 40,000 iterations, growth before 15,000, decay over 30,000."""
        return paper().replace(
            {
                "method": "surgicalgaussian",
                "temporal.weight": 0.0,
                "density.stop_iteration": 1500,
                "density.grow_threshold": 3e-4,
                "density.min_densify_weight": 1.0,
                "optim.scales_lr": 1e-3,
                "optim.decay_iterations": 3000,
                "schedule.coarse_iterations": 0,
                "schedule.fine_iterations": 4000,
                "schedule.sh_every": 1000,
            }
        )

    def motion(self, cfg: Config) -> Motion:
        """See `Method.motion`."""
        return self._motion

    def first_gaussians(self, frames: Sequence[Frame], cfg: Config) -> FirstGaussians:
        """See `GaussianMethod.first_gaussians`."""
        return resting_spheres(grid_points(frames, EVERY_PX, FIRST_PX), cfg.init.opacity)

    def position(self, seed: int, stage: Stage, iteration: int, num_frames: int, rng: np.random.Generator) -> int:
        """See `GaussianMethod.position`."""
        return in_epochs(seed, stage, iteration, num_frames)

    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        """See `GaussianMethod.rate`; the network has no length."""
        if not name.startswith("network"):
            return rate_of(name, cfg, UNIT_MM)
        steps = round(NETWORK_LATER * cfg.optim.decay_iterations)
        return lambda iteration: log_linear(NETWORK_LR, FINAL_SHARE * NETWORK_LR, iteration, steps)

    def terms(self, drawn: Drawn, cfg: Config, ops: TrainingOps) -> dict[str, Tensor]:
        """See `GaussianMethod.terms`."""
        frame, out, gaussians = drawn.frame, drawn.out, drawn.gaussians
        mask = frame.tissue_mask[..., None]
        color, target = out.color * mask, frame.rgb * mask
        terms = {
            "color": COLOR_SHARE * (color - target).abs().mean(),
            "ssim": (1 - COLOR_SHARE) * (1 - ssim(color, target)),
            "tv": TV_WEIGHT * 2 * total_variation(out.color * ~mask),
            "depth": DEPTH_WEIGHT * ((out.depth - frame.depth) * frame.measured).abs().mean() / UNIT_MM,
        }
        return terms if drawn.offsets is None else terms | neighbor_terms(gaussians, drawn.offsets, drawn.splats)

    def plan(
        self, stats: DensityStats, gaussians: Gaussians, extent: float, stage: Stage, iteration: int, cfg: Config
    ) -> Plan:
        """See `GaussianMethod.plan`: also what is large goes, once opacities were reset."""
        planned = density.plan(stats, gaussians.scales, gaussians.opacities, UNIT_MM, cfg.density)
        if iteration <= RESET_EVERY:
            return planned
        large = gaussians.scales.amax(-1) > MOST_SCALE * UNIT_MM
        large &= ~planned.split
        rules = {**planned.removed_by, "size": large}
        return Plan(clone=planned.clone & ~large, split=planned.split, remove=planned.remove | large, removed_by=rules)

    def reset_due(self, stage: Stage, iteration: int, cfg: Config) -> bool:
        """See `GaussianMethod.reset_due`; the first one belongs to the white background."""
        inside = iteration < cfg.density.stop_iteration
        return inside and (iteration == FIRST_RESET or iteration % RESET_EVERY == 0)


def neighbor_terms(gaussians: Gaussians, offsets: Offsets, splats: Splats) -> dict[str, Tensor]:
    """How much the distances between neighbors, and those between their covariances, differ from the canonical ones.

    As released, the deformed covariance has the raw quaternion plus its offset, not the one that is drawn.
    """
    means, quats = gaussians["means"], gaussians["quats"]
    found, _ = nearest(means.detach().cpu().numpy(), min(NUM_NEIGHBORS, len(means) - 1))
    neighbors = torch.from_numpy(found).to(means.device)
    moved = quats + (offsets.quats + quats - normalize(quats, dim=-1))
    before, after = covariances(quats, gaussians.scales / UNIT_MM), covariances(moved, splats.scales / UNIT_MM)
    return {
        "distance": DISTANCE_WEIGHT * distance_change(means / UNIT_MM, splats.means / UNIT_MM, neighbors),
        "shape": SHAPE_WEIGHT * distance_change(before, after, neighbors),
    }


METHOD = SurgicalGaussian()
