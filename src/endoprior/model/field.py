"""What all Gaussians of a scene share to move: a function of place and time with parameters of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from .hexplane import PlaneGrid


class Field(ABC):
    """Autograd trains `parameters`; planes, of which one iteration touches few cells, get theirs in `grid.grads`."""

    grid: PlaneGrid | None = None
    """Planes over space and time, if it has some."""

    @property
    @abstractmethod
    def parameters(self) -> dict[str, Tensor]:
        """Every tensor that autograd trains, by the name that it has in checkpoints."""

    @abstractmethod
    def state_arrays(self) -> dict[str, Tensor]:
        """Every number that defines the field, by name; views of live memory, not copies."""

    @abstractmethod
    def to(self, device: torch.device | str, *, fp16_planes: bool = False) -> Field:
        """This field on a device; itself if it is there. A copy starts without gradients.

        Args:
            fp16_planes: keep planes in half precision, on any device but the CPU: for rendering only.
        """
