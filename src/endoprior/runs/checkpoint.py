"""The state of a training run as one safetensors file: written whole, named, versioned, no pickle."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.checks import InputError
from ..core.config import Config
from ..core.config_io import to_dict
from ..model.hexplane import TOUCHED, plane_shapes
from ..model.schema import model_schema
from ..system.arrays_file import ArraySpec, load_arrays, rejecting, save_arrays
from ..training.density import DensityStats
from ..training.state import Stage
from ..training.step import stage_length
from ..training.trainer import Trainer
from .identity import reject_other_run

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = "endoprior-checkpoint-1"


def save_checkpoint(trainer: Trainer, path: Path, fingerprint: str) -> None:
    """Write everything that the next iteration depends on.

    Args:
        fingerprint: of the sequence; a run only resumes on the same data.
    """
    about = {
        "stage": int(trainer.state.stage),
        "iteration": trainer.state.iteration,
        "config": to_dict(trainer.cfg),
        "fingerprint": fingerprint,
    }
    save_arrays(path, trainer.state.arrays(), about, FORMAT)


def load_checkpoint(trainer: Trainer, path: Path, fingerprint: str) -> None:
    """Restore the saved state in `trainer`.

    Raises:
        InputError: the file is missing or damaged, or belongs to another config or other data.
    """
    if not os.path.isfile(path):
        raise InputError(f"{path}: expected a checkpoint to resume from; found none. Start without --resume.")
    cfg, next_step = trainer.cfg, "Train again without --resume."

    def schema(about: dict[str, Any]) -> dict[str, ArraySpec]:
        reject_other_run(path, about["config"], about["fingerprint"], cfg, fingerprint, trainer.sequence.path)
        return checkpoint_schema(cfg) | _frame_specs(trainer)

    arrays, about = load_arrays(path, {FORMAT: schema}, next_step)
    with rejecting(path, "a training state", next_step):
        stage, iteration = Stage(about["stage"]), about["iteration"]
        length = stage_length(cfg, stage)
        if type(iteration) is not int or not 0 <= iteration <= length:
            raise InputError(
                f"expected 0 to {length} as iteration of the {stage.name.lower()} stage; got {iteration!r:.80}."
            )
        check_state(arrays, iteration)
        followed, num_frames = arrays.get("tracks.followed"), len(trainer.sequence.indices("train"))
        counts = {"tracks.followed": followed.shape[1]} if followed is not None else {}
        counts |= {name: len(arrays[name]) for name in ("poses.steps", "depth_fit") if name in arrays}
        for name, got in counts.items():
            if got != num_frames:
                raise InputError(f"expected {num_frames} training frames in {name}; got {got}.")
    trainer.restore(stage, iteration, arrays)


def checkpoint_schema(cfg: Config) -> dict[str, ArraySpec]:
    """The arrays of a checkpoint: the model, Adam's moments, statistics; `N` Gaussians, `K` touched cells."""
    model = model_schema(cfg)
    trained = {name.removeprefix("gaussians."): spec for name, spec in model.items() if name.startswith("gaussians.")}
    network = [spec for name, spec in model.items() if name.startswith("field.heads.")]
    trained |= {f"network.{i}": spec for i, spec in enumerate(network)}
    planes = {}
    if cfg.deformation.kind == "hexplane":
        if cfg.deformation.hexplane.learn_box:
            trained["box"] = model["field.hexplane.box"]
        moments = ArraySpec("float32", ("K", cfg.deformation.hexplane.channels))
        cells = sum(
            rows * columns for scale in plane_shapes(cfg.deformation.hexplane) for rows, columns in scale.values()
        )
        planes = {"marks": ArraySpec("uint8", (cells,)), "exp_avg": moments, "exp_avg_sq": moments}
        planes["steps"] = ArraySpec("int64", (1,))
    optimizer = {f"{name}.{moment}": spec for name, spec in trained.items() for moment in ("first", "second")}
    for name, spec in trained.items():
        optimizer[f"{name}.steps"] = ArraySpec("int64", (spec.shape[1] if name == "motion" else 1,))
    optimizer |= {f"plane_adam.{name}": spec for name, spec in planes.items()}
    stats = {f"stats.{field.name}": ArraySpec("float32", ("N",)) for field in fields(DensityStats)}
    found = {f"optimizer.{name}": spec for name, spec in optimizer.items()}
    return model | found | stats | _track_specs(cfg)


def _frame_specs(trainer: Trainer) -> dict[str, ArraySpec]:
    """What is found of each of the `F` training frames: its pose, and how its depth fits."""
    specs = {}
    if trainer.step_once.poses is not None:
        specs = {f"poses.{name}": ArraySpec("float64", ("F", 6)) for name in ("twists", "first", "second", "accepted")}
        specs["poses.steps"] = ArraySpec("int64", ("F",))
    return specs | ({"depth_fit": ArraySpec("float64", ("F", 2))} if trainer.fits_depth else {})


def _track_specs(cfg: Config) -> dict[str, ArraySpec]:
    """The tracks to which motion is held, where it is; `P` tracks, `F` training frames."""
    if not (cfg.loss.track_weight and cfg.init.motion == "flow"):
        return {}
    specs = {"coefficients": ArraySpec("float32", ("P", cfg.deformation.basis.num_bases, 3))}
    specs |= {"followed": ArraySpec("float32", ("P", "F")), "rows": ArraySpec("int64", ("N",))}
    return {f"tracks.{name}": spec for name, spec in specs.items()}


def check_state(arrays: Mapping[str, Tensor], iteration: int) -> None:
    """Reject arrays of a checkpoint, finite and of the right shapes, that no training can produce.

    Raises:
        InputError: naming the array.
    """
    for name, value in arrays.items():
        if name.startswith("stats.") or name.endswith((".second", ".exp_avg_sq")):
            valid, expected = bool((value >= 0).all()), "no negative number"
        elif name.endswith(".steps"):
            valid, expected = bool(((value >= 0) & (value <= iteration)).all()), f"0 to {iteration} steps"
        elif name == "tracks.rows":
            num = len(arrays["tracks.coefficients"])
            valid, expected = bool(((value >= 0) & (value < num)).all()), f"rows below {num}"
        elif name.endswith(".marks"):
            touched = len(arrays["optimizer.plane_adam.exp_avg"])
            valid = bool((value <= TOUCHED).all()) and int(value.count_nonzero()) == touched
            expected = f"{touched} touched cells"
        else:
            continue
        if not valid:
            raise InputError(f"expected {expected} in {name}; got something else.")
