"""A method that consists of moving Gaussians: it derives from `GaussianMethod`, and changes what `GaussianHooks` lists.

See docs/add_a_method.md for the smallest complete one.
"""

from __future__ import annotations

from ..core.config import Config
from ..data import FrameSequence
from .gaussian_hooks import GaussianHooks
from .gaussian_trainer import GaussianTrainer
from .trainer import Trainer


class GaussianMethod(GaussianHooks):
    """See `GaussianHooks` for what a subclass gives and may override."""

    def trainer(self, sequence: FrameSequence, cfg: Config) -> Trainer:
        """See `Method.trainer`."""
        return GaussianTrainer(sequence, cfg)
