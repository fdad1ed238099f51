"""What a file that holds a scene or a training state must hold: names, types and shapes, all from the config alone."""

from __future__ import annotations

from ..core.checks import InputError
from ..core.config import Config
from ..system.arrays_file import ArraySpec
from .basis import motion_layout
from .deformation import state_shapes


def model_schema(cfg: Config) -> dict[str, ArraySpec]:
    """The Gaussians and the field that moves them; `N` Gaussians.

    Raises:
        InputError: the config leaves the number of temporal bases open.
    """
    return {f"gaussians.{name}": spec for name, spec in _gaussians(cfg).items()} | {
        f"field.{name}": ArraySpec("float32", shape) for name, shape in _field(cfg).items()
    }


def _gaussians(cfg: Config) -> dict[str, ArraySpec]:
    shapes: dict[str, tuple[int | str, ...]] = {
        "means": ("N", 3),
        "quats": ("N", 4),
        "log_scales": ("N", 3),
        "opacity_logits": ("N",),
        "sh_dc": ("N", 1, 3),
        "sh_rest": ("N", (cfg.schedule.sh_degree + 1) ** 2 - 1, 3),
    }
    if cfg.deformation.kind == "basis":
        num_bases = cfg.deformation.basis.num_bases
        if num_bases == 0:
            raise InputError("config.deformation.basis.num_bases: expected at least 2; got 0.")
        shapes["motion"] = ("N", num_bases, max(part.stop for part in motion_layout(cfg.deformation).values()))
    return {name: ArraySpec("float32", shape) for name, shape in shapes.items()}


def _field(cfg: Config) -> dict[str, tuple[int, ...]]:
    return state_shapes(cfg.deformation) if cfg.deformation.kind == "hexplane" else {}
