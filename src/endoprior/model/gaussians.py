"""The canonical Gaussians: the table of their trained tensors, activations, and what offsets make of them.

`N` Gaussians; every tensor's first axis is the Gaussian. Raw values are unconstrained: `exp` turns `log_scales` into
mm, the logistic function turns `opacity_logits` into opacities. Shapes and temporal offsets follow `ATTRIBUTES`: to
give Gaussians a new attribute, add a row there, its learning rate to `training.optimizer.RATES`, its starting value to
`create_gaussians` in `initialization`, and its use to `Gaussians.splats`. Files, checkpoints and density control need
no change. A gradient of what moves them that is large, and simple to compute, is not stored: the optimizer gets what it
is computed from.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.checks import InputError
from ..core.config import Config
from ..core.config_deformation import DeformationConfig
from ..core.types import Splats
from ..render.sh import C0


@dataclass(frozen=True)
class Attribute:
    """One trained tensor of the Gaussians; its first axis, N, is the Gaussian."""

    name: str
    width: int
    """Numbers per Gaussian that a deformation may add an offset to: 3 for colors, whatever their degree."""
    changes: Callable[[DeformationConfig], bool] = lambda _: False
    """Whether it changes with time."""


ATTRIBUTES = (
    Attribute("means", 3, lambda _: True),
    Attribute("quats", 4, lambda cfg: cfg.deform_shape),
    Attribute("log_scales", 3, lambda cfg: cfg.deform_shape),
    Attribute("opacity_logits", 1, lambda cfg: cfg.deform_opacity),
    Attribute("sh_dc", 3, lambda cfg: cfg.kind == "basis"),
    Attribute("sh_rest", 3),
    Attribute("color_slopes", 3),
    Attribute("gloss", 3),
)
"""Every attribute but the temporal coefficients (`temporal_shapes`). The channels of `changes` and the heads of a
HexPlane field follow this order."""


def offset_widths(cfg: DeformationConfig) -> dict[str, int]:
    """Attributes that change with time under `cfg`, in order, with the numbers that an offset of each has."""
    return {a.name: a.width for a in ATTRIBUTES if a.changes(cfg)}


def change_layout(cfg: Config) -> dict[str, slice]:
    """Channels of `changes`, the temporal coefficients of all attributes but the centers, by attribute.

    If both eyes are trained on, also of what the right eye sees more: only coefficients change that.
    """
    widths = offset_widths(cfg.deformation) | ({"gloss": 3} if cfg.data.eyes == "both" else {})
    layout, start = {}, 0
    for name, width in widths.items():
        if name != "means":
            layout[name] = slice(start, start + width)
            start += width
    return layout


def temporal_shapes(cfg: Config) -> dict[str, tuple[int, int]]:
    """Basis functions and channels of the tensors that `basis.py` moves Gaussians by.

    `motion`: displacement of the centers, mm, by spline functions; `changes`: see `change_layout`, by fewer of them;
    `frame_motion`: displacement at each frame beside the spline, mm, which is not trained by gradients.

    Raises:
        InputError: the config leaves the number of temporal basis functions open.
    """
    basis = cfg.deformation.basis
    if basis.num_bases == 0:
        raise InputError("config.deformation.basis.num_bases: expected at least 4; got 0.")
    channels = max((part.stop for part in change_layout(cfg).values()), default=0)
    return {
        "motion": (basis.num_bases, 3),
        "changes": (basis.num_change_bases, channels),
        "frame_motion": (basis.num_frames, 3),
    }


def attribute_shapes(cfg: Config) -> dict[str, tuple[int, ...]]:
    """Shape of each tensor that Gaussians have whatever moves them, without its first axis."""
    shapes: dict[str, tuple[int, ...]] = {a.name: (a.width,) for a in ATTRIBUTES}
    shapes["opacity_logits"] = ()
    shapes["sh_dc"], shapes["sh_rest"] = (1, 3), ((cfg.schedule.sh_degree + 1) ** 2 - 1, 3)
    shapes["color_slopes"] = (2, 3)
    if not cfg.render.color_slopes:
        del shapes["color_slopes"]
    if cfg.data.eyes == "both":  # what the right eye sees more: of the color, then of its slopes
        shapes["gloss"] = (3 if cfg.render.color_slopes else 1, 3)
    else:
        del shapes["gloss"]
    return shapes


SH_C0 = C0
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi))."""


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
        """Offsets from tensors (N, width) by name, as `offset_widths` names them; scales within bounds."""
        if "opacity_logits" in channels:
            channels["opacity_logits"] = channels["opacity_logits"][:, 0]
        if "log_scales" in channels and cfg.max_scale_change > 1:
            limit = math.log(cfg.max_scale_change)
            channels["log_scales"] = channels["log_scales"].clamp(-limit, limit)
        return Offsets(**channels)


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


class Gaussians:
    """Trainable per-Gaussian tensors, by name.

    Names are those of `ATTRIBUTES`, shapes those of `attribute_shapes`: centers in mm, quaternions wxyz,
    spherical harmonics (coefficient, channel). What moves them may add its own: `Motion.tensors`.
    """

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        self.tensors = {name: value.detach().contiguous().requires_grad_() for name, value in tensors.items()}
        self.motion_gradients: list[Gradient] = []
        """Gradient of what moves them since the last optimizer step, one entry per time step."""

    def to(self, device: torch.device | str) -> Gaussians:
        """These Gaussians on a device; themselves if they are there."""
        device = torch.device(device)
        if self["means"].device.type == device.type:
            return self
        return Gaussians({name: value.detach().to(device) for name, value in self.tensors.items()})

    def __len__(self) -> int:
        return len(self.tensors["means"])

    def __getitem__(self, name: str) -> Tensor:
        return self.tensors[name]

    @property
    def scales(self) -> Tensor:
        """(N, 3) canonical standard deviations, mm."""
        return self.tensors["log_scales"].exp()

    @property
    def opacities(self) -> Tensor:
        """(N,) canonical opacities in (0, 1)."""
        return self.tensors["opacity_logits"].sigmoid()

    def splats(self, offsets: Offsets | None, sh_degree: int, right_share: float = 0.0) -> Splats:
        """Activate the parameters, moved by `offsets` (None: canonical), with color up to `sh_degree`.

        Args:
            right_share: how far the color is that of the right eye, in [0, 1]: see `core.geometry.share_of_right`.
        """
        t = self.tensors
        sh_dc = t["sh_dc"]
        if offsets is not None and offsets.sh_dc is not None:
            sh_dc = sh_dc + offsets.sh_dc[:, None, :]
        color_slopes = t.get("color_slopes")
        if right_share and "gloss" in t:
            gloss = t["gloss"]
            if offsets is not None and offsets.gloss is not None:
                gloss = torch.cat([gloss[:, :1] + offsets.gloss[:, None, :], gloss[:, 1:]], 1)
            gloss = right_share * gloss
            sh_dc = sh_dc + gloss[:, :1]
            color_slopes = color_slopes if color_slopes is None else color_slopes + gloss[:, 1:]
        sh_rest = _moved(t["sh_rest"], offsets and offsets.sh_rest)
        num_rest = (sh_degree + 1) ** 2 - 1
        return Splats(
            means=_moved(t["means"], offsets and offsets.means),
            quats=_moved(t["quats"], offsets and offsets.quats),
            scales=_moved(t["log_scales"], offsets and offsets.log_scales).exp(),
            opacities=_moved(t["opacity_logits"], offsets and offsets.opacity_logits).sigmoid(),
            sh=torch.cat([sh_dc, sh_rest[:, :num_rest]], 1) if num_rest else sh_dc,
            color_slopes=color_slopes,
        )


def _moved(value: Tensor, offset: Tensor | None) -> Tensor:
    return value if offset is None else value + offset


def with_colors(splats: Splats, colors: NDArray | Tensor) -> Splats:
    """The same Gaussians, each of one color, (N, 3): numbers to blend in its place, for example."""
    sh = (torch.as_tensor(colors).to(splats.sh)[:, None] - 0.5) / SH_C0
    return replace(splats, sh=sh.contiguous(), color_slopes=None)
