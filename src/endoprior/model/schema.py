"""Arrays of a file that holds a scene or a training state: names, types and shapes, all from the config alone."""

from __future__ import annotations

from ..core.config import Config
from ..system.arrays_file import ArraySpec
from .attributes import attribute_shapes
from .deformation import state_shapes


def model_schema(cfg: Config) -> dict[str, ArraySpec]:
    """The Gaussians and the field that moves them; `N` Gaussians.

    Raises:
        InputError: the config leaves the number of temporal basis functions open.
    """
    gaussians = {f"gaussians.{name}": ("N", *shape) for name, shape in attribute_shapes(cfg).items()}
    field = state_shapes(cfg.deformation) if cfg.deformation.kind == "hexplane" else {}
    shapes = gaussians | {f"field.{name}": shape for name, shape in field.items()}
    return {name: ArraySpec("float32", shape) for name, shape in shapes.items()}
