"""Deform3DGS: Gaussians that move by learned basis functions over time. Yang et al., MICCAI 2024, as released.

Its loss and its density control are the defaults, with the weights of `config`. What differs from the release, and why,
is in docs/methods.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from endoprior.core.config import Config
from endoprior.core.types import Frame
from endoprior.initialization.first_gaussians import FirstGaussians, resting_spheres
from endoprior.model.gaussians import Gaussians
from endoprior.model.motion import Field, Motion, Offsets
from endoprior.model.ops import ModelOps
from endoprior.model.presets import paper
from endoprior.training.gaussian_method import GaussianMethod
from endoprior.training.optimizer import Rate, rate_of

from .deform3dgs_points import SHARE, first_points
from .learned_basis import COEFFICIENTS, value_at

NUM_BASES = 17
"""Basis functions of each Gaussian and channel."""
CHANNELS = {"means": 3, "quats": 4, "log_scales": 3}
"""What moves, in the order of the channels."""
FIRST_WIDTH = 0.01
SPATIAL_SCALE = 10.0
"""Factor of the rates of centers and coefficients, whatever the camera does."""


class LearnedBasisMotion(Motion):
    """Coefficients of each Gaussian: weight, center and width of 17 basis functions in each of 10 channels."""

    def tensors(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.tensors`."""
        return dict.fromkeys(COEFFICIENTS, (NUM_BASES, sum(CHANNELS.values())))

    def first_tensors(self, num: int, cfg: Config) -> dict[str, Tensor]:
        """See `Motion.first_tensors`."""
        size = (num, NUM_BASES, sum(CHANNELS.values()))
        centers = torch.linspace(0, 1, NUM_BASES)[None, :, None].expand(size)
        return dict(zip(COEFFICIENTS, (torch.zeros(size), centers, torch.full(size, FIRST_WIDTH)), strict=True))

    def offsets(
        self,
        gaussians: Gaussians,
        field: Field | None,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """See `Motion.offsets`. Unless some are chosen, the gradient goes to `gaussians.motion_gradients`."""
        coefficients = [gaussians[name] if chosen is None else gaussians[name][chosen] for name in COEFFICIENTS]
        sink = gaussians.motion_gradients if chosen is None else None
        parts = value_at(*coefficients, time, sink).split(list(CHANNELS.values()), 1)
        return Offsets(**dict(zip(CHANNELS, parts, strict=True)))


class Deform3DGS(GaussianMethod):
    """See `GaussianMethod`."""

    uses_prior = False
    color_is_error = True
    first_share = SHARE
    clone_extent = 0.0  # what grows is split
    _motion = LearnedBasisMotion()

    def config(self) -> Config:
        """What its preset starts from. The rates are those of 3DGS: the defaults."""
        return paper().replace(
            {
                "method": "deform3dgs",
                "loss.tv_weight": 0.0,
                "temporal.weight": 0.0,
                "density.min_densify_weight": 1.0,
                "schedule.coarse_iterations": 0,
            }
        )

    def motion(self, cfg: Config) -> Motion:
        """See `Method.motion`."""
        return self._motion

    def first_gaussians(self, frames: Sequence[Frame], cfg: Config) -> FirstGaussians:
        """See `GaussianMethod.first_gaussians`."""
        return resting_spheres(first_points(frames, cfg.seed), cfg.init.opacity)

    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        """See `GaussianMethod.rate`: coefficients learn as centers do."""
        return rate_of("means" if name in COEFFICIENTS else name, cfg, SPATIAL_SCALE)


METHOD = Deform3DGS()
