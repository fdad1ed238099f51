"""The arrays of a `GaussiansState`: names, types and shapes, all from the config alone.

`N` Gaussians, `K` touched cells of planes, `P` tracks, `F` training frames.
"""

from __future__ import annotations

from dataclasses import fields

from ..core.config import Config
from ..model.hexplane import plane_shapes
from ..model.motion import Motion
from ..model.schema import gaussians_schema
from ..system.arrays_file import ArraySpec
from .density import DensityStats
from .left_out import VISITS


def state_schema(motion: Motion, cfg: Config, *, doubts: bool) -> dict[str, ArraySpec]:
    """The model, Adam's moments, the statistics of density control, and the tracks that hold motion, if any.

    Args:
        doubts: also how much of each frame was left out as a missed tool.
    """
    model = gaussians_schema(motion, cfg)
    trained = {name.removeprefix("gaussians."): spec for name, spec in model.items() if name.startswith("gaussians.")}
    trained |= {name: ArraySpec("float32", shape) for name, shape in motion.parameter_shapes(cfg).items()}
    optimizer = {f"{name}.{moment}": spec for name, spec in trained.items() for moment in ("first", "second")}
    for name, spec in trained.items():
        optimizer[f"{name}.steps"] = ArraySpec("int64", (spec.shape[1] if name == "motion" else 1,))
    planes = motion.planes(cfg)
    if planes is not None:
        moments = ArraySpec("float32", ("K", planes.channels))
        cells = sum(rows * columns for scale in plane_shapes(planes) for rows, columns in scale.values())
        of_planes = {"marks": ArraySpec("uint8", (cells,)), "exp_avg": moments, "exp_avg_sq": moments}
        of_planes["steps"] = ArraySpec("int64", (1,))
        optimizer |= {f"plane_adam.{name}": spec for name, spec in of_planes.items()}
    found = {f"optimizer.{name}": spec for name, spec in optimizer.items()}
    found |= {f"stats.{field.name}": ArraySpec("float32", ("N",)) for field in fields(DensityStats)}
    found |= {"left_out": ArraySpec("float32", ("F", VISITS))} if doubts else {}
    return model | found | _track_schema(cfg)


def _track_schema(cfg: Config) -> dict[str, ArraySpec]:
    if not (cfg.loss.track_weight and cfg.init.motion == "flow"):
        return {}
    specs = {"coefficients": ArraySpec("float32", ("P", cfg.deformation.basis.num_bases, 3))}
    specs |= {"followed": ArraySpec("float32", ("P", "F")), "rows": ArraySpec("int64", ("N",))}
    return {f"tracks.{name}": spec for name, spec in specs.items()}
