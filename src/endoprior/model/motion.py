"""How Gaussians move: offsets at a time, what is trained for them, and what a training step leaves for the optimizer.

Two ways to hold motion, and a method may use both: tensors of each Gaussian, which follow it when it is cloned, split
or removed (`basis.py` has ours); and a `Field` that all Gaussians share (`hexplane_field.py` has the paper's). Offsets
are added to the raw parameters: centers (mm), log scales, quaternions before normalization, opacity logits.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.config import Config
from ..core.config_deformation import DeformationConfig, HexPlaneConfig
from ..system.arrays_file import ArraySpec
from .gaussians import attribute_shapes

if TYPE_CHECKING:
    from .gaussians import Gaussians
    from .hexplane import PlaneGrid
    from .ops_interface import ModelOps


@dataclass(frozen=True)
class Offsets:
    """What one time step adds to the raw parameters of N Gaussians; None where nothing is added."""

    means: Tensor
    """(N, 3) displacement of the centers, mm."""
    log_scales: Tensor | None = None
    """(N, 3)."""
    quats: Tensor | None = None
    """(N, 4), added before normalization."""
    opacity_logits: Tensor | None = None
    """(N,)."""
    sh_dc: Tensor | None = None
    """(N, 3), added to the spherical-harmonic coefficient of degree 0."""
    sh_rest: Tensor | None = None
    """(N, (D+1)**2 - 1, 3), added to those of the other degrees."""
    gloss: Tensor | None = None
    """(N, 3), added to what the right eye sees more of the color, a coefficient of degree 0."""

    @staticmethod
    def from_channels(channels: dict[str, Tensor], cfg: DeformationConfig) -> Offsets:
        """Offsets from tensors (N, width) by name, as `gaussians.offset_widths` names them; scales within bounds."""
        if "opacity_logits" in channels:
            channels["opacity_logits"] = channels["opacity_logits"][:, 0]
        if "log_scales" in channels and cfg.max_scale_change > 1:
            limit = math.log(cfg.max_scale_change)
            channels["log_scales"] = channels["log_scales"].clamp(-limit, limit)
        return Offsets(**channels)


class Field(ABC):
    """What all Gaussians of a scene share to move: a function of place and time.

    Autograd trains `parameters`; planes, of which one iteration touches few cells, get theirs in `grid.grads`.
    """

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


class Motion(ABC):
    """One way to move Gaussians. It has no state: what is trained is in the Gaussians and in the field."""

    stays_at_the_ends = False
    """Gaussians stay, before and after the training frames, where they are at the first and the last of these."""

    def tensors(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """Shape, without the first axis, of each tensor that Gaussians have for it.

        Raises:
            InputError: the config leaves a shape open.
        """
        del cfg  # for subclasses
        return {}

    def first_tensors(self, num: int, cfg: Config) -> dict[str, Tensor]:
        """These tensors of `num` Gaussians before training: zeros, unless a method starts otherwise."""
        return {name: torch.zeros(num, *shape) for name, shape in self.tensors(cfg).items()}

    def field(self, points: Tensor, cfg: Config) -> Field | None:
        """The field around the initial points (N, 3), mm, before training; None: no field."""
        del points, cfg  # for subclasses
        return None

    def field_of(self, arrays: Mapping[str, Tensor], cfg: Config) -> Field | None:
        """The field whose `state_arrays` these are.

        Raises:
            InputError: an array is missing or has another shape.
        """
        del arrays, cfg  # for subclasses
        return None

    def field_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """Shapes of the field's `state_arrays`."""
        del cfg  # for subclasses
        return {}

    def parameter_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """Shapes of the field's `parameters`."""
        del cfg  # for subclasses
        return {}

    def planes(self, cfg: Config) -> HexPlaneConfig | None:
        """The planes of the field, if it has some."""
        del cfg  # for subclasses
        return None

    @abstractmethod
    def offsets(
        self,
        gaussians: Gaussians,
        field: Field | None,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """Offsets of the Gaussians, or of the `chosen` (P,) ones only, at `time` in [0, 1]; differentiable."""

    def schema(self, cfg: Config) -> dict[str, ArraySpec]:
        """Arrays of a file that holds the Gaussians and the field that moves them; `N` Gaussians.

        Raises:
            InputError: the config leaves the number of temporal basis functions open.
        """
        per_gaussian = attribute_shapes(cfg) | self.tensors(cfg)
        shapes: dict[str, tuple[str | int, ...]] = {f"gaussians.{name}": ("N", *s) for name, s in per_gaussian.items()}
        shapes |= {f"field.{name}": shape for name, shape in self.field_shapes(cfg).items()}
        return {name: ArraySpec("float32", shape) for name, shape in shapes.items()}


@dataclass(frozen=True)
class RankOneGradient:
    """Gradient of temporal coefficients (N, B, C) from one time step: the outer product of two vectors.

    It is 30 times smaller than the coefficients, and the optimizer uses it in this form.
    """

    name: str
    """The tensor of the Gaussians that it is the gradient of."""
    weights: NDArray[np.float64]
    """(B,) values of the basis functions at the time."""
    v_offsets: Tensor
    """(N, C) gradient of the offsets at the time."""


class UnstoredGradient(ABC):
    """Gradient of tensors of the Gaussians at one time, never written to memory: Adam computes it as it uses it.

    For tensors so large that writing and reading their gradient costs as much as the rest of the step. CPU.
    """

    names: ClassVar[tuple[str, ...]]
    """The tensors; they have one learning rate."""
    v_offsets: Tensor
    """(N, channels) gradient of the offsets at the time."""

    @staticmethod
    @abstractmethod
    def adam_step(
        gradients: Sequence[Any],
        tensors: Sequence[NDArray[np.float32]],
        firsts: Sequence[NDArray[np.float32]],
        seconds: Sequence[NDArray[np.float32]],
        rate: np.float32,
        root_scale: np.float32,
        constants: tuple[np.float32, np.float32, np.float32],
    ) -> None:
        """One step of Adam in place, with the sum of `gradients`, all of this class.

        Args:
            tensors, firsts, seconds: the tensors as in `names`, and Adam's moments of each.
            rate: learning rate / (1 - beta1^steps). root_scale: 1 / sqrt(1 - beta2^steps).
            constants: beta1, beta2, epsilon.
        """


Gradient = RankOneGradient | UnstoredGradient
"""What a time step leaves for the optimizer."""
