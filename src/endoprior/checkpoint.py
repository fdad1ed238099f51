"""The state of a training run as one safetensors file: written whole, named, versioned, no pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from .arrays_file import load_arrays, part, save_arrays
from .checks import InputError
from .config_io import to_dict
from .density import DensityStats
from .model.deformation import HexPlaneField
from .model.gaussians import Gaussians
from .optim import Optimizer
from .train_state import Stage, TrainState

if TYPE_CHECKING:
    from .trainer import Trainer

FORMAT = "endoprior-checkpoint-1"


def save_checkpoint(trainer: Trainer, path: Path, fingerprint: str) -> None:
    """Write everything that the next iteration depends on.

    Args:
        fingerprint: of the sequence; a run is only continued on the same data.
    """
    state = trainer.state
    arrays = {f"gaussians.{name}": value.detach() for name, value in state.gaussians.tensors.items()}
    arrays |= {f"stats.{name}": value for name, value in state.stats.tensors().items()}
    arrays |= {f"optimizer.{name}": value for name, value in state.optimizer.state_arrays().items()}
    if state.field is not None:
        arrays |= {f"field.{name}": value for name, value in state.field.state_arrays().items()}
    about = {
        "stage": int(state.stage),
        "iteration": state.iteration,
        "config": to_dict(trainer.cfg),
        "fingerprint": fingerprint,
    }
    save_arrays(path, arrays, about, FORMAT)


def load_checkpoint(trainer: Trainer, path: Path, fingerprint: str) -> None:
    """Put `trainer` into the saved state.

    Raises:
        InputError: the file is missing or damaged, or belongs to another config or other data.
    """
    if not path.is_file():
        raise InputError(f"{path}: expected a checkpoint to resume from; found none. Start without --resume.")
    arrays, about = load_arrays(path, FORMAT, "Train again without --resume.")
    if about["config"] != json.loads(json.dumps(to_dict(trainer.cfg))):
        changed = _first_difference(about["config"], to_dict(trainer.cfg))
        raise InputError(f"{path}: config differs at {changed}. Resume with the options the run was started with.")
    if about["fingerprint"] != fingerprint:
        raise InputError(f"{path}: was trained on other data than {trainer.sequence.path}. Pass the same sequence.")

    gaussians = Gaussians(part(arrays, "gaussians."))
    field = None
    if trainer.cfg.deformation.kind == "hexplane":
        field = HexPlaneField(torch.tensor([[1.0] * 3, [0.0] * 3]), trainer.cfg.deformation, torch.Generator())
        field.load_state_arrays(part(arrays, "field."))
    optimizer = Optimizer(gaussians, field, trainer.cfg, trainer.spatial_scale)
    optimizer.load_state_arrays(part(arrays, "optimizer."))
    stats = DensityStats(**part(arrays, "stats."))
    trainer.state = TrainState(Stage(about["stage"]), about["iteration"], gaussians, field, optimizer, stats)


def _first_difference(old: dict, new: dict, where: str = "") -> str:
    """Path and both values of the first field that differs."""
    for name, value in new.items():
        if isinstance(value, dict) and isinstance(old.get(name), dict):
            if found := _first_difference(old[name], value, f"{where}{name}."):
                return found
        elif json.loads(json.dumps(value)) != old.get(name):
            return f"{where}{name} ({old.get(name)!r} in the checkpoint, {value!r} now)"
    return ""
