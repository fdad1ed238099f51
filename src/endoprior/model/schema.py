"""Arrays of a file that holds moving Gaussians: names, types and shapes, all from the config alone."""

from __future__ import annotations

from ..core.config import Config
from ..system.arrays_file import ArraySpec
from .attributes import attribute_shapes
from .motion import Motion


def gaussians_schema(motion: Motion, cfg: Config) -> dict[str, ArraySpec]:
    """The Gaussians and the field that moves them; `N` Gaussians.

    Raises:
        InputError: the config leaves the number of temporal basis functions open.
    """
    per_gaussian = attribute_shapes(cfg) | motion.tensors(cfg)
    shapes: dict[str, tuple[str | int, ...]] = {f"gaussians.{name}": ("N", *s) for name, s in per_gaussian.items()}
    shapes |= {f"field.{name}": shape for name, shape in motion.field_shapes(cfg).items()}
    return {name: ArraySpec("float32", shape) for name, shape in shapes.items()}
