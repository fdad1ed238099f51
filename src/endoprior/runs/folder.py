"""The run folder: who may write to it, and `config.json`, which says what run it holds: config, versions, data."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml

from ..core.checks import InputError, input_error
from ..core.config import Config
from ..core.config_io import to_dict
from ..core.shell import command
from ..data import FrameSequence
from ..data.files import read_json
from ..data.reading import kind_of, load_yaml, read_text
from ..model.method import config_from
from ..render import ON_GPU
from ..system.atomic import is_leftover, reject_occupied
from ..system.devices import name_of
from ..system.file_lock import locked
from ..system.installation import source_commit
from ..training.trainer import device_for

LOCK = ".lock"
"""File that a process holds while it trains in a folder."""
CONFIG, LOG, CHECKPOINT, SCENE = "config.json", "log.jsonl", "checkpoint.safetensors", "scene.safetensors"
"""Names of its files."""


def reject_unusable_folder(out: Path, *, resume: bool) -> None:
    """Reject a folder that cannot take a run; nothing is created yet.

    Raises:
        InputError: it is a file, or it holds something and `resume` is False, or its name is not usable.
    """
    exists = kind_of(out) == "a folder"
    if not (resume and exists):
        is_run = exists and (out / CONFIG).is_file()
        resume_it = f", or resume the run in it: `{command('train', '--resume', out)}`" if is_run else ""
        reject_occupied(out, resume_it, ignore=lambda file: file.name == LOCK or is_leftover(file))


def prepare_run_folder(out: Path, *, resume: bool) -> None:
    """Make sure that `out` exists and can take a run.

    Raises:
        InputError: as `reject_unusable_folder`, or it cannot be made.
    """
    reject_unusable_folder(out, resume=resume)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a place for a folder, got {error.strerror}. Fix: Choose another.") from error


@contextmanager
def held_folder(out: Path, *, resume: bool, begin: Callable[[], None]) -> Iterator[None]:
    """Hold a run folder, which no other process can use meanwhile, after `begin` has begun the run in it.

    Raises:
        InputError: the folder cannot take the run; where the run did not begin, one that was created is removed.
    """
    existed, began = out.is_dir(), False
    prepare_run_folder(out, resume=resume)
    try:
        with locked(out, out / LOCK):
            begin()
            began = True
            yield
    except InputError:
        if not (began or existed):
            shutil.rmtree(out, ignore_errors=True)
        elif not (began or resume):
            (out / CONFIG).unlink(missing_ok=True)
        raise


def accept_resumed(out: Path, cfg: Config, fingerprint: str, data: Path) -> None:
    """Raise InputError unless `config.json` says that the folder holds a run with this config on these data."""
    about = out / CONFIG
    stored = read_json(about)
    facts = stored.get("data")
    known = facts.get("fingerprint") if isinstance(facts, dict) else None
    reject_other_run(about, stored.get("config"), known, cfg, fingerprint, data)


def reject_other_run(
    file: Path, stored_config: Any, stored_fingerprint: Any, cfg: Config, fingerprint: str, data: Path
) -> None:
    """Reject resuming with another config or on other data.

    Args:
        file: where the stored ones come from; named in the message.
        stored_config, stored_fingerprint: as read from it.
        cfg, fingerprint: the current ones.
        data: folder of the sequence, for the message.
    Raises:
        InputError: the config differs, with the names of all fields that do, or the data do.
    """
    if changed := ", ".join(_differences(to_dict(config_of(stored_config, file)), to_dict(cfg))):
        fix = f"`{command('train', '--resume', file.parent)}` takes the options of the folder"
        raise InputError(f"{file}: config differs at {changed}. Fix: {fix}; a new run needs a new folder.")
    if stored_fingerprint != fingerprint:
        raise InputError(f"{file}: was trained on other data than {data}. Fix: Pass the same sequence.")


def _differences(old: dict[str, Any], new: dict[str, Any], where: str = "") -> Iterator[str]:
    """Each field that differs, with both values."""
    for name, value in new.items():
        if isinstance(value, dict) and isinstance(old[name], dict):
            yield from _differences(old[name], value, f"{where}{name}.")
        elif value != old[name]:
            yield f"{where}{name} ({old[name]!s:.80} in the folder, {value!s:.80} now)"


def run_facts(sequence: FrameSequence, cfg: Config, fingerprint: str) -> dict[str, Any]:
    """Contents of `config.json`, to repeat the run: every config field, versions, commit, backend, device, data."""
    backend = cfg.render.backend
    names = ["endoprior", "torch", "numpy", "numba", "scipy", "opencv-python-headless"]
    names += [backend] if backend in ON_GPU else []
    return {
        "config": to_dict(cfg),
        "seed": cfg.seed,
        "backend": backend,
        "device": name_of(device_for(backend)),
        "commit": source_commit(),
        "versions": {name: version(name) for name in names} | {"python": sys.version.split()[0]},
        "data": {"path": str(sequence.path.resolve()), "fingerprint": fingerprint, "frames": len(sequence)},
    }


def config_of_run(run: Path) -> Config:
    """The config that a run was started with, from its `config.json`.

    Raises:
        InputError: the file is missing or cannot be used.
    """
    file = run / CONFIG
    return config_of(read_json(file, "pass the folder of a run that was interrupted.").get("config"), file)


def sequence_of_run(run: Path, hint: str = "pass --data FOLDER.") -> Path:
    """The sequence folder a run was trained on, from its `config.json`.

    Args:
        hint: the fix of the error message.
    Raises:
        InputError: `config.json` is missing or does not name the folder, or the folder does not exist.
    """
    file = run / CONFIG
    facts = read_json(file, hint).get("data")
    path = facts.get("path") if isinstance(facts, dict) else None
    if not isinstance(path, str) or not path:
        raise input_error(file, "the path of the sequence", repr(path), hint)
    data = Path(path)
    if kind_of(data) != "a folder":
        raise input_error(data, "the sequence this run was trained on", "no such folder", hint)
    return data


def read_config(file: Path, base: Config) -> Config:
    """The config in a file: `config.json` of a run, or YAML or JSON with some fields; `base` gives the others.

    Raises:
        InputError: the file cannot be read, has an unknown field, or a value of the wrong kind or range.
    """
    fix = "pass config.json of a run, or a YAML file with fields of the config."
    if file.suffix.lower() == ".json":
        values = read_json(file, fix)
    else:
        try:
            values = load_yaml(read_text(file, "a config", fix))
        except yaml.YAMLError as error:
            raise input_error(file, "YAML", " ".join(str(error).split())[:120], fix) from None
    if isinstance(values, dict) and "config" in values:  # a run's file, which also names versions and data
        values = values["config"]
    if not isinstance(values, dict):
        raise input_error(file, "named fields of the config", type(values).__name__, fix)
    return config_of(_merged(to_dict(base), values), file)


def config_of(values: Any, file: Path) -> Config:
    """The config that was read from `file`, named in the InputError; fields that it lacks get their default."""
    try:
        return config_from(values)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """`base` with the entries of `changes`; dicts in both are merged."""
    both = {key for key in changes if isinstance(base.get(key), dict) and isinstance(changes[key], dict)}
    return base | {key: _merged(base[key], value) if key in both else value for key, value in changes.items()}
