"""What a method is: which config it starts from, how it trains, and what its scenes are made of.

Reading frames, run folders, logs, checkpoints, scoring and rendering are the same for all. A method that consists of
moving Gaussians is a `training.gaussian_method.GaussianMethod`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING

from torch import Tensor

from ..core.config import Config
from ..core.methods import method_named
from ..system.arrays_file import ArraySpec

if TYPE_CHECKING:
    from ..core.types import Camera
    from ..data import FrameSequence
    from ..training.trainer import Trainer
    from .motion import Motion
    from .scene import RenderedScene
    from .scene_facts import SceneFacts


class Method(ABC):
    """One way from a sequence to a scene."""

    background = (0.0, 0.0, 0.0)
    """Color behind everything, in [0, 1], in training and where its scenes are rendered."""

    has_gaussians = True
    """Whether its scenes consist of Gaussians: a `Scene`; else they are only a `RenderedScene`."""

    @abstractmethod
    def config(self) -> Config:
        """The config that the preset of its name starts from."""

    @abstractmethod
    def trainer(self, sequence: FrameSequence, cfg: Config) -> Trainer:
        """A training that has not computed anything yet.

        Raises:
            InputError: the sequence or the config cannot be used.
        """

    @abstractmethod
    def schema(self, cfg: Config) -> dict[str, ArraySpec]:
        """The arrays that its scenes are saved as, beside the cameras; `N` Gaussians, if there are any."""

    @abstractmethod
    def scene(self, arrays: Mapping[str, Tensor], cameras: tuple[Camera, ...], facts: SceneFacts) -> RenderedScene:
        """The scene whose arrays these are; they fit `schema`.

        Raises:
            InputError: a value that no scene can have.
        """

    def motion(self, cfg: Config) -> Motion:
        """How its Gaussians move.

        Raises:
            TypeError: it has no Gaussians.
        """
        raise TypeError(f"{cfg.method} has no Gaussians")


def method_of(cfg: Config) -> Method:
    """The method of a config."""
    return method_named(cfg.method)


def motion_of(cfg: Config) -> Motion:
    """How the Gaussians of a config move.

    Raises:
        TypeError: its method has none.
    """
    return method_of(cfg).motion(cfg)
