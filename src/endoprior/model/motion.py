"""How Gaussians move: what is trained for it, and the `Offsets` that follow from it at a time.

Two ways to hold motion, and a method may use both: tensors of each Gaussian, which follow it when it is cloned, split
or removed (`basis.py` has ours); and a `Field` that all Gaussians share (`hexplane_field.py` has the paper's). Offsets
are added to the raw parameters: centers (mm), log scales, quaternions before normalization, opacity logits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ..core.config import Config
from ..core.config_deformation import HexPlaneConfig
from ..system.arrays_file import ArraySpec
from .gaussians import Gaussians, Offsets, attribute_shapes
from .hexplane import PlaneGrid


@dataclass(frozen=True)
class ModelOps:
    """The operations that motions are computed by; `ops.py` has their two implementations."""

    name: str
    weighted_sum: Callable[..., Tensor]
    """Offsets from temporal coefficients: see `basis.weighted_sum`."""
    weighted_sum_backward: Callable[..., Tensor]
    """Its gradient: see `basis.weighted_sum_backward`."""
    hexplane_linear: Callable[..., tuple[Tensor, ...]]
    """A linear layer on HexPlane features: see `hexplane.hexplane_linear`."""
    fuse_heads: bool
    """Compute the hidden layers of all heads as one matrix product: fewer and larger launches on a GPU."""


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
