"""EndoGS: a HexPlane moves everything, rays weighted by tools. As released, 2024.

Field: HexPlane features, trunk (linear F -> W, ReLU, linear W -> W) and one head (ReLU, linear W -> W, ReLU, linear
W -> 59) for center 3, scale 3, rotation 4, opacity 1, color 48. What differs from the release, and why, is in
docs/methods.md. Terms of its loss that carry no gradient there (entropy of opacities, signed distance, normals) are
left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, huber_loss, relu
from typing_extensions import override

from endoprior.compute.relu_network import relu_network
from endoprior.core.config import Config
from endoprior.core.config_deformation import DeformationConfig
from endoprior.model.gaussians import Gaussians, Offsets
from endoprior.model.hexplane_field import HexPlaneField, HexPlaneMotion, LinearLayers, num_features
from endoprior.model.motion import Field, ModelOps
from endoprior.training.density import CLONE_EXTENT, MAX_GAUSSIANS, DensityStats, Plan
from endoprior.training.frames import TrainingFrames
from endoprior.training.gaussian_hooks import in_epochs
from endoprior.training.losses import total_variation
from endoprior.training.ops import TrainingOps
from endoprior.training.optimizer import PLANES, Rate, log_linear, rate_of
from endoprior.training.state import ForwardPass
from endoprior.training.trainer import Stage

from .plane_terms import PlaneWeights, planes_of
from .released import Released

UNIT_MM = 10.0
"""Unit of length of what the network gives. COLMAP's, which is any; with this one a scene 10 cm wide has the extent 5
that the release takes."""
OUTPUTS = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1, "sh": 48}
"""What the head gives, in order."""
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
PRUNE_EVERY, RESET_EVERY = 7000, 6000
MAX_SCALE_SHARE = 0.1
"""After the opacity reset at 6,000 larger Gaussians go; share of the extent.

As in `surgicalgaussian`, the radius of 20 px that the release also names is left out.
"""


class JointField(HexPlaneField):
    """See the head of this file."""

    width = 256

    @override
    @classmethod
    def layer_shapes(cls, cfg: DeformationConfig) -> dict[str, tuple[int, int]]:
        width = cls.width
        layers = {"trunk": (width, num_features(cfg))} | {name: (width, width) for name in ("second", "hidden")}
        return layers | {"output": (sum(OUTPUTS.values()), width)}

    @override
    @classmethod
    def make_heads(cls, cfg: DeformationConfig, generator: torch.Generator, zero_biases: bool) -> LinearLayers:
        return LinearLayers(cls.layer_shapes(cfg), generator, zero_biases)

    @override
    def offsets(self, means: Tensor, time: float, ops: ModelOps) -> Offsets:
        (trunk,) = self.trunk(means, (time,), ops)
        layers = [self.heads.layer(name) for name in ("second", "hidden", "output")]
        values = relu_network(relu(trunk), layers)
        parts = dict(zip(OUTPUTS, values.split(list(OUTPUTS.values()), 1), strict=True))
        parts["means"] = UNIT_MM * parts["means"]
        sh = parts.pop("sh").reshape(len(means), 16, 3)
        opacity = parts.pop("opacity_logits")[:, 0]
        return Offsets(**parts, opacity_logits=opacity, sh_dc=sh[:, 0], sh_rest=sh[:, 1:])


class JointMotion(HexPlaneMotion):
    """See `JointField`."""

    field_class = JointField

    @override
    def offsets(
        self,
        gaussians: Gaussians,
        field: Field | None,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """Colors beyond the degree of the Gaussians are left out."""
        found = super().offsets(gaussians, field, time, cfg, ops, chosen)
        assert found.sh_rest is not None
        return replace(found, sh_rest=found.sh_rest[:, : gaussians["sh_rest"].shape[1]])


class EndoGS(Released):
    """See `GaussianMethod`."""

    background = (1.0, 1.0, 1.0)
    keeps_optimizer = True
    growth_ends, last_reset = 0.75, 0.7
    first_reset, reset_every = 500, RESET_EVERY
    name = "endogs"
    way = JointMotion()
    changes: ClassVar[Mapping[str, Any]] = {  # published: 3,000 and 60,000 iterations
        "init.sampler": "pool",
        "deformation.hexplane.time_resolution": 75,
        "deformation.hexplane.channels": 32,
        "density.stop_iteration": 45_000,
        "optim.decay_iterations": 1_000_000,
        "schedule.fine_iterations": 5000,
        "schedule.sh_every": 1000,
    }

    @override
    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        if name != "box" and name != PLANES and not name.startswith("network"):
            return rate_of(name, cfg, EXTENT_MM)
        scale, start = EXTENT_MM if name == "box" else SPATIAL_SCALE, PLANES_RATE
        if name.startswith("network"):
            start = NETWORK_RATE
        return lambda iteration: scale * log_linear(start, start, iteration, cfg.optim.decay_iterations)

    @override
    def position(self, cfg: Config, stage: Stage, iteration: int, num_frames: int, rng: np.random.Generator) -> int:
        return in_epochs(cfg.seed, stage, iteration, num_frames)

    @override
    def context(self, frames: TrainingFrames, cfg: Config) -> Tensor:
        """(H, W) 1 + 30 F / ||F||, F the number of frames in which a tool hides the pixel."""
        hidden = (~frames.frame(0).tissue_mask).float()
        for i in range(1, len(frames)):
            hidden += ~frames.frame(i).tissue_mask
        norm = hidden.norm()
        return 1 + OFTEN_HIDDEN * (hidden / norm if norm else hidden)

    @override
    def terms(self, forward: ForwardPass, cfg: Config, ops: TrainingOps) -> dict[str, Tensor]:
        frame, out = forward.frame, forward.out
        mask, weight = frame.tissue_mask[..., None], forward.context
        if weight.shape != frame.tissue_mask.shape:  # at half resolution
            height, width = frame.tissue_mask.shape
            weight = adaptive_avg_pool2d(weight[None], (height, width))[0]
        terms = {
            "color": ((out.color - frame.rgb).abs() * mask * weight[..., None]).mean(),
            "depth": DEPTH_WEIGHT * depth_huber(out.depth, frame.depth, frame.measured),
            "tv": TV_WEIGHT * total_variation(out.color * ~mask),
        }
        return terms | planes_of(forward, PLANE_WEIGHTS)

    @override
    def plan(
        self, stats: DensityStats, gaussians: Gaussians, extent: float, stage: Stage, iteration: int, cfg: Config
    ) -> Plan:
        """Grow every time, prune seldom."""
        gradient, largest = stats.grad2d_ndc_sum / stats.num_seen.clamp(min=1), gaussians.scales.amax(-1)
        grow = gradient >= cfg.density.grow_threshold
        small = largest <= CLONE_EXTENT * EXTENT_MM
        faint = gaussians.opacities < cfg.density.prune_opacity
        large = (largest > MAX_SCALE_SHARE * EXTENT_MM) & (iteration > RESET_EVERY)
        remove = (faint | large) & (iteration % PRUNE_EVERY == 0)
        if len(grow) + int(grow.sum()) > MAX_GAUSSIANS:
            grow = torch.zeros_like(grow)
        split = grow & ~small
        rules = {"opacity": faint, "size": large}
        return Plan(clone=grow & small & ~remove, split=split, remove=remove & ~split, removed_by=rules)


def depth_huber(depth: Tensor, target: Tensor, measured: Tensor) -> Tensor:
    """Huber loss, mean over all pixels, of depths that are each divided by the largest of their image.

    Args:
        depth, target: (H, W) mm; the largest value of each counts wherever it is; that of `depth` has a gradient.
        measured: (H, W) bool; other pixels are 0 on both sides.
    """
    scaled, wanted = (values / (values.max() + DEPTH_EPSILON) * measured for values in (depth, target))
    return huber_loss(scaled, wanted, delta=HUBER_DELTA)


METHOD = EndoGS()
