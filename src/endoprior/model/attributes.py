"""What one Gaussian has: the table of its trained tensors. Shapes, learning rates and temporal offsets all follow it.

To give Gaussians a new attribute, add a row here, its starting value to `create_gaussians` and its use to
`Gaussians.splats`. Files, checkpoints, the optimizer and density control need no change.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..core.checks import InputError
from ..core.config import Config
from ..core.config_deformation import DeformationConfig


@dataclass(frozen=True)
class Attribute:
    """One trained tensor of the Gaussians; its first axis, N, is the Gaussian."""

    name: str
    width: int
    """Numbers per Gaussian that a deformation may add an offset to: 3 for colors, whatever their degree."""
    rate: str
    """Field of `OptimConfig`: learning rate. Where `<rate>_final` exists too, the rate decays to it."""
    basis_rate: str = ""
    """Field of `OptimConfig`: learning rate of its temporal coefficients. Empty: it never changes with time."""
    switch: str = ""
    """Field of `DeformationConfig` that lets it change with time. Empty: it always does, if it ever does."""


ATTRIBUTES = (
    Attribute("means", 3, "means_lr", "basis_means_lr"),
    Attribute("quats", 4, "quats_lr", "basis_quats_lr", "deform_quats"),
    Attribute("log_scales", 3, "scales_lr", "basis_log_scales_lr", "deform_scales"),
    Attribute("opacity_logits", 1, "opacity_lr", "basis_opacity_lr", "deform_opacity"),
    Attribute("sh_dc", 3, "sh_dc_lr", "basis_color_lr"),
    Attribute("sh_rest", 3, "sh_rest_lr"),
    Attribute("color_slopes", 3, "color_slopes_lr"),
)
"""Every attribute but `motion`, the temporal coefficients of the others. The channels of `motion` and the heads of a
HexPlane field follow this order."""


def offset_widths(cfg: DeformationConfig) -> dict[str, int]:
    """Attributes that change with time under `cfg`, in order, with the numbers that an offset of each has."""
    changing = [a for a in ATTRIBUTES if a.basis_rate and (not a.switch or getattr(cfg, a.switch))]
    with_color = cfg.kind == "basis" and cfg.basis.deform_color
    return {a.name: a.width for a in changing if a.name != "sh_dc" or with_color}


def motion_layout(cfg: DeformationConfig) -> dict[str, slice]:
    """Channels of `motion` by the attribute that they change."""
    layout, start = {}, 0
    for name, width in offset_widths(cfg).items():
        layout[name] = slice(start, start + width)
        start += width
    return layout


def motion_shape(cfg: DeformationConfig) -> tuple[int, int]:
    """Basis functions and channels of `motion`.

    Raises:
        InputError: the config leaves the number of temporal basis functions open.
    """
    if cfg.basis.num_bases == 0:
        raise InputError("config.deformation.basis.num_bases: expected at least 2; got 0.")
    return cfg.basis.num_bases, sum(offset_widths(cfg).values())


def attribute_shapes(cfg: Config) -> dict[str, tuple[int, ...]]:
    """Shape of each tensor that Gaussians have whatever moves them, without its first axis."""
    shapes: dict[str, tuple[int, ...]] = {a.name: (a.width,) for a in ATTRIBUTES}
    shapes["opacity_logits"] = ()
    shapes["sh_dc"], shapes["sh_rest"] = (1, 3), ((cfg.schedule.sh_degree + 1) ** 2 - 1, 3)
    shapes["color_slopes"] = (2, 3)
    if not cfg.render.color_slopes:
        del shapes["color_slopes"]
    return shapes
