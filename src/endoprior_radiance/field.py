"""What a radiance field is to the trainer and to a scene: networks that render rays and compare them with a frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Generator, Tensor, nn

from endoprior.system.arrays_file import ArraySpec

from .presets import RadianceConfig
from .rays import Composited, RayFrames, Rays


@dataclass(frozen=True)
class RayBatch:
    """`N` rays of one training frame, and what the frame shows there."""

    rays: Rays
    time: float
    """In [0, 1)."""
    color: Tensor
    """(N, 3) in [0, 1]."""
    depth: Tensor
    """(N,) z of the surface, mm; 0 where it was not measured."""

    @property
    def measured(self) -> Tensor:
        """(N,) whether there is a depth."""
        return self.depth > 0


class RadianceField(nn.Module, ABC):
    """Networks and the facts of the sequence that they need, as buffers; all float32.

    A new one has no values: `start` or `load_state_dict` gives them.
    """

    only_measured: ClassVar[bool]
    """Whether rays are drawn only where there is a depth."""

    def __init__(self, cfg: RadianceConfig) -> None:
        super().__init__()
        self.cfg = cfg

    @abstractmethod
    def start(self, frames: RayFrames, generator: Generator) -> None:
        """First values: those of the sequence from its training frames, those of the networks at random."""

    @abstractmethod
    def losses(self, batch: RayBatch, share: float, rng: np.random.Generator) -> dict[str, Tensor]:
        """Weighted terms, () each; their sum is what training minimizes.

        Args:
            share: of the iterations that this one completes, in (0, 1].
            rng: of this iteration; every random number comes from it.
        """

    @staticmethod
    @abstractmethod
    def color_term(color: Tensor, target: Tensor) -> Tensor:
        """The term `color` of `losses`, (), of rays that show `color` (N, 3) where the frame shows `target`."""

    @abstractmethod
    def render(self, rays: Rays, time: float) -> Composited:
        """What the rays show at `time` in [0, 1], depth in mm as the sum of weight * z; without gradients."""

    @staticmethod
    @abstractmethod
    def rate(share: float) -> float:
        """Factor of the learning rate when `share`, in (0, 1], of the iterations is done."""

    @classmethod
    def schema(cls, cfg: RadianceConfig) -> dict[str, ArraySpec]:
        """Its arrays by name, as `state_dict` gives them."""
        with torch.device("meta"):
            field = cls(cfg)
        return {name: ArraySpec("float32", tuple(value.shape)) for name, value in field.state_dict().items()}

    def wrong_values(self) -> str:
        """What no trained field can have, of finite values from a file; empty if nothing is wrong."""
        return ""

    @property
    def device(self) -> torch.device:
        """Where it lies."""
        return next(self.parameters()).device


def uniform(rng: np.random.Generator, *shape: int, device: torch.device) -> Tensor:
    """Random numbers in [0, 1), float32: the same ones on every device."""
    return torch.from_numpy(rng.random(shape, np.float32)).to(device)


def normal(rng: np.random.Generator, *shape: int, device: torch.device) -> Tensor:
    """Random numbers of the standard normal distribution, float32: the same ones on every device."""
    return torch.from_numpy(rng.standard_normal(shape, np.float32)).to(device)
