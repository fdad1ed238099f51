"""What a method is: one way from a sequence to a scene.

One that consists of moving Gaussians is a `gaussian_method.GaussianMethod`.
"""

from __future__ import annotations

from abc import abstractmethod

from ..core.checks import input_error
from ..core.config import Config
from ..data import FrameSequence
from ..model.method import SceneKind, method_of
from .trainer import Trainer


class Method(SceneKind):
    """How a method trains, beside what its scenes are made of."""

    @abstractmethod
    def trainer(self, sequence: FrameSequence, cfg: Config) -> Trainer:
        """A training that has not computed anything; InputError if the sequence or the config cannot be used."""


def trainer_for(sequence: FrameSequence, cfg: Config) -> Trainer:
    """A training by the method of a config that has not computed anything; InputError as in `Method.trainer`."""
    method = method_of(cfg)
    if not isinstance(method, Method):
        raise input_error("method", "one that trains", cfg.method, "Derive it from endoprior.training.method.Method.")
    return method.trainer(sequence, cfg)
