"""What a method of moving Gaussians may change. Everything but the motion has a default: our own way.

A method derives from `gaussian_method.GaussianMethod`, which adds the training that asks all this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from ..core.config import Config
from ..core.types import Camera, Frame
from ..initialization.first_gaussians import FirstGaussians, first_gaussians
from ..model.gaussians import Gaussians
from ..model.scene import SingleScene
from ..model.scene_facts import SceneFacts
from ..system.arrays_file import ArraySpec
from . import density
from .density import Plan
from .density_stats import DensityStats
from .frames import TrainingFrames
from .losses import supervised_terms
from .method import Method
from .ops import TrainingOps
from .optimizer import Rate, rate_of
from .state import ForwardPass
from .trainer import Stage

EPOCHS = 2**31  # keeps the random numbers of epochs apart from those of iterations


class GaussianHooks(Method):
    """See `Method`. A subclass gives its `motion`, and overrides what it does differently.

    Arguments with an underscore are for methods that decide by more than our own does.
    """

    uses_prior = True  # the texture prior of the frames is computed, for density control and the temporal term
    keeps_optimizer = False  # Adam's moments and steps go on from the coarse to the fine stage
    starts_from_flow = False  # its Gaussians can start with the motion that optical flow finds: `init.motion flow`.
    color_is_error = False
    """Its term `color` is the mean absolute error over tissue; else the divergence check has that computed."""
    first_share = 0.0
    """Share of the pixels of the first training frame, where it shows tissue with depth, that become Gaussians; 0: it
    starts with `init.budget` of them."""

    clone_extent = density.CLONE_EXTENT
    """Gaussians with a scale up to this share of the scene extent are cloned, larger ones split."""

    def schema(self, cfg: Config) -> dict[str, ArraySpec]:
        """See `Method.schema`."""
        per_gaussian = {name: ArraySpec("float32", ("N",)) for name in ("prior_score", "num_valid")}
        return self.motion(cfg).schema(cfg) | per_gaussian

    def scene(self, arrays: Mapping[str, Tensor], cameras: tuple[Camera, ...], facts: SceneFacts) -> SingleScene:
        """See `Method.scene`."""
        return SingleScene.of_arrays(arrays, cameras, facts, self.motion(facts.config))

    def first_gaussians(self, frames: Sequence[Frame], cfg: Config) -> FirstGaussians:
        """The Gaussians before training; InputError if the training frames give too few points."""
        return first_gaussians(frames, cfg)

    def rate(self, name: str, cfg: Config, spatial_scale: float) -> Rate:
        """Learning rate of a tensor of the Gaussians, of a parameter of the field or of its planes."""
        return rate_of(name, cfg, spatial_scale)

    def position(self, cfg: Config, stage: Stage, iteration: int, num_frames: int, rng: np.random.Generator) -> int:
        """The training frame of an iteration; a pure function of its arguments. `rng` belongs to the iteration."""
        if stage is not Stage.FINE:
            return 0
        if cfg.schedule.literal:
            return int(rng.integers(num_frames))
        return in_epochs(cfg.seed, stage, iteration, num_frames)

    def context(self, frames: TrainingFrames, cfg: Config) -> Any:
        """What the loss needs of all training frames, made once: `ForwardPass.context`."""

    def terms(self, forward: ForwardPass, cfg: Config, ops: TrainingOps) -> dict[str, Tensor]:
        """The weighted terms of the loss, () each."""
        return supervised_terms(forward.out, forward.frame, cfg.loss, ops.supervised_losses)

    def density_due(self, stage: Stage, iteration: int, last: bool, cfg: Config) -> bool:
        """Whether Gaussians are cloned, split and removed after this iteration; `last`: of the stage."""
        return density.due(iteration, stage is Stage.FINE and last, cfg.density)

    def plan(
        self, stats: DensityStats, gaussians: Gaussians, extent: float, _stage: Stage, _iteration: int, cfg: Config
    ) -> Plan:
        """What to clone, split and remove; see `density.plan`."""
        scales, opacities = gaussians.scales, gaussians.opacities
        return density.plan(stats, scales, opacities, extent, cfg.density, cfg.released, self.clone_extent)

    def reset_due(self, _stage: Stage, _iteration: int, _cfg: Config) -> bool:
        """Whether opacities are lowered to 0.01 after this iteration."""
        return False

    def empty_error(self, brightness: float) -> float:
        """Mean absolute color error of an image of the background alone, over tissue of that mean color in [0, 1].

        At most that, where the background is no gray.
        """
        return abs(sum(self.background) / 3 - brightness)


def in_epochs(seed: int, stage: Stage, iteration: int, num_frames: int) -> int:
    """A position for `GaussianHooks.position`: every frame once in each epoch, in random order."""
    epoch, place = divmod(iteration - 1, num_frames)
    return int(np.random.default_rng([seed, int(stage), EPOCHS, epoch]).permutation(num_frames)[place])
