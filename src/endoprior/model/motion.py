"""How the Gaussians of a method move: what is trained for it, and the offsets at a time.

Two ways to hold motion, and a method may use both: tensors of each Gaussian, which follow it when it is cloned, split
or removed; and a `Field` that all Gaussians share.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..core.config import Config
from ..core.config_deformation import HexPlaneConfig
from .attributes import motion_shape
from .basis import basis_offsets
from .deformation import HexPlaneField, Offsets
from .field import Field
from .ops import ModelOps

if TYPE_CHECKING:
    from .gaussians import Gaussians


class Motion(ABC):
    """One way to move Gaussians. It has no state: what is trained is in the Gaussians and in the field."""

    stays_at_the_ends = False
    """Gaussians stay, before and after the training frames, where they are at the first and the last of these."""

    def tensors(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """Shape, without the first axis, of each tensor that Gaussians have for it.

        Raises:
            InputError: the config leaves a shape open.
        """
        return {}

    def first_tensors(self, num: int, cfg: Config) -> dict[str, Tensor]:
        """These tensors of `num` Gaussians before training: zeros, unless a method starts otherwise."""
        return {name: torch.zeros(num, *shape) for name, shape in self.tensors(cfg).items()}

    def field(self, points: Tensor, cfg: Config) -> Field | None:
        """The field around the initial points (N, 3), mm, before training; None: no field."""
        return None

    def field_of(self, arrays: Mapping[str, Tensor], cfg: Config) -> Field | None:
        """The field whose `state_arrays` these are.

        Raises:
            InputError: an array is missing or has another shape.
        """
        return None

    def field_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """Shapes of the field's `state_arrays`."""
        return {}

    def parameter_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """Shapes of the field's `parameters`."""
        return {}

    def planes(self, cfg: Config) -> HexPlaneConfig | None:
        """The planes of the field, if it has some."""
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


class HexPlaneMotion(Motion):
    """The paper's: a field of space-time planes."""

    field_class: type[HexPlaneField] = HexPlaneField

    def field(self, points: Tensor, cfg: Config) -> HexPlaneField:
        """See `Motion.field`."""
        return self.field_class.from_points(points, cfg.deformation, torch.Generator().manual_seed(cfg.seed))

    def field_of(self, arrays: Mapping[str, Tensor], cfg: Config) -> HexPlaneField:
        """See `Motion.field_of`."""
        return self.field_class.from_state_arrays(arrays, cfg.deformation)

    def field_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.field_shapes`."""
        return self.field_class.state_shapes(cfg.deformation)

    def parameter_shapes(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.parameter_shapes`."""
        return self.field_class.parameter_shapes(cfg.deformation)

    def planes(self, cfg: Config) -> HexPlaneConfig:
        """See `Motion.planes`."""
        return cfg.deformation.hexplane

    def offsets(
        self,
        gaussians: Gaussians,
        field: HexPlaneField,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """See `Motion.offsets`."""
        means = gaussians["means"]
        return field.offsets(means if chosen is None else means[chosen], time, ops)


class BasisMotion(Motion):
    """Ours: temporal coefficients of each Gaussian."""

    stays_at_the_ends = True  # a temporal basis that no frame holds leads anywhere

    def tensors(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.tensors`."""
        return {"motion": motion_shape(cfg.deformation)}

    def offsets(
        self,
        gaussians: Gaussians,
        field: None,
        time: float,
        cfg: Config,
        ops: ModelOps,
        chosen: Tensor | None = None,
    ) -> Offsets:
        """See `Motion.offsets`. Unless some are chosen, the gradient goes to `gaussians.motion_gradients`."""
        rows = slice(None) if chosen is None else chosen
        sink = gaussians.motion_gradients if chosen is None else None
        return basis_offsets(gaussians["motion"][rows], time, cfg.deformation, ops, sink)
