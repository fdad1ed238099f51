"""How Gaussians move: offsets at a time, what is trained for them, and the temporal basis, our own way to move.

Two ways to hold motion, and a method may use both: tensors of each Gaussian, which follow it when it is cloned, split
or removed; and a `Field` that all Gaussians share (`hexplane_field.py` has the paper's). Offsets are added to the raw
parameters: centers (mm), log scales, quaternions before normalization, opacity logits.

Temporal basis: offset_i(t) = sum_b w_b(t) motion_i,b with w_b(t) = max(0, (exp(-d^2 / 2) - e) / (1 - e)),
d = (t - c_b) / s and e = exp(-3^2 / 2): a Gaussian, lowered by 0.011 so that its support ends at three standard
deviations without a jump. Centers c_b lie evenly on [0, 1], s = 1.5 / B. Zero coefficients are the identity.
Yang et al., "Deform3DGS", MICCAI 2024, use a basis of this kind per Gaussian.
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
from torch.autograd.function import once_differentiable
from typing_extensions import override

from ..core.checks import check_shape
from ..core.config import Config
from ..core.config_deformation import BasisConfig, DeformationConfig, HexPlaneConfig
from ..system.arrays_file import ArraySpec
from .gaussians import attribute_shapes, motion_shape, motion_widths

if TYPE_CHECKING:
    from .gaussians import Gaussians
    from .hexplane import PlaneGrid
    from .ops import ModelOps

RELATIVE_WIDTH = 1.5
"""Standard deviation of a basis function in units of 1 / B."""
SUPPORT = 3.0
"""Half of the support of a basis function, in standard deviations."""


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
        """Offsets from tensors (N, width) by name, as `motion_widths` names them; scales within bounds."""
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


class BasisMotion(Motion):
    """Ours: temporal coefficients of each Gaussian."""

    stays_at_the_ends = True  # a temporal basis that no frame holds leads anywhere

    def tensors(self, cfg: Config) -> dict[str, tuple[int, ...]]:
        """See `Motion.tensors`."""
        return {"motion": motion_shape(cfg)}

    @override
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
        rows = slice(None) if chosen is None else chosen
        sink = gaussians.motion_gradients if chosen is None else None
        return basis_offsets(gaussians["motion"][rows], time, cfg, ops, sink)


def basis_weights(time: float, cfg: BasisConfig) -> NDArray[np.float64]:
    """(B,) values w_b(t) of the basis functions, in [0, 1]."""
    distance = time - np.linspace(0, 1, cfg.num_bases)
    sigma = RELATIVE_WIDTH / cfg.num_bases
    end = np.exp(-0.5 * SUPPORT**2)
    return np.maximum(0.0, (np.exp(-0.5 * (distance / sigma) ** 2) - end) / (1 - end))


def basis_offsets(
    motion: Tensor,
    time: float,
    cfg: Config,
    ops: ModelOps,
    sink: list[RankOneGradient | UnstoredGradient] | None = None,
) -> Offsets:
    """Offsets at `time` of Gaussians with coefficients `motion`, differentiable in `motion`.

    Args:
        motion: (N, B, channels) coefficients; channels as in `motion_layout`, those of the centers in mm.
        time: in [0, 1].
        sink: takes the gradient of `motion` in place of `motion.grad`. The gradient of one time step is an outer
            product, 30 times smaller than the coefficients, and the optimizer can use it in this form.
    Raises:
        ValueError: a wrong shape.
    """
    num_bases, channels = motion_shape(cfg)
    check_shape(f"motion:N,{num_bases},{channels}", motion=motion)
    total = _WeightedSum.apply(motion, basis_weights(time, cfg.deformation.basis), sink, ops)
    widths = motion_widths(cfg)  # `split` has one gradient; slices have one each, of full size, to add up
    parts = dict(zip(widths, total.split(list(widths.values()), 1), strict=True))
    return Offsets.from_channels(parts, cfg.deformation)


@dataclass(frozen=True)
class RankOneGradient:
    """Gradient of `motion` from one time step: the outer product of weights (B,) and v_offsets (N, channels)."""

    weights: NDArray[np.float64]
    v_offsets: Tensor


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


class _WeightedSum(torch.autograd.Function):
    """sum_b weights[b] * motion[:, b]."""

    @staticmethod
    def forward(
        ctx: Any, motion: Tensor, weights: NDArray[np.float64], sink: list[Gradient] | None, ops: ModelOps
    ) -> Tensor:
        ctx.weights, ctx.sink, ctx.ops = weights, sink, ops
        return ops.weighted_sum(motion.detach(), weights)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_out: Tensor) -> tuple[Tensor | None, None, None, None]:
        if ctx.sink is not None:
            ctx.sink.append(RankOneGradient(ctx.weights, v_out.contiguous()))
            return None, None, None, None
        return ctx.ops.weighted_sum_backward(v_out, ctx.weights), None, None, None


def weighted_sum(motion: Tensor, weights: NDArray) -> Tensor:
    """(N, C) sum_b weights[b] * motion[:, b] in PyTorch, on any device; `basis_numba.py` computes the same.

    Args:
        motion: (N, B, C) coefficients. weights: (B,) values of the basis functions.
    """
    return torch.matmul(_like(weights, motion), motion)


def weighted_sum_backward(v_out: Tensor, weights: NDArray) -> Tensor:
    """(N, B, C) gradient of `motion`, given that of the sum, (N, C)."""
    return v_out[:, None] * _like(weights, v_out)[:, None]


def _like(weights: NDArray, values: Tensor) -> Tensor:
    return torch.as_tensor(weights).to(values.device, values.dtype, non_blocking=True)
