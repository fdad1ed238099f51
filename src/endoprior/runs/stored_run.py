"""What `config.json` says about a run: its config and its sequence. Also reads the config of any file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from ..core.checks import InputError, input_error
from ..core.config import Config
from ..core.config_io import to_dict
from ..data.files import read_json
from ..data.reading import kind_of, load_yaml, read_text
from ..model.method import config_from


def config_of_run(run: Path) -> Config:
    """The config that a run was started with, from its `config.json`.

    Raises:
        InputError: the file is missing or cannot be used.
    """
    file = run / "config.json"
    return config_of(read_json(file, "pass the folder of a run that was interrupted.").get("config"), file)


def sequence_of_run(run: Path, hint: str = "pass --data FOLDER.") -> Path:
    """The sequence folder a run was trained on, from its `config.json`.

    Args:
        hint: the fix of the error message.
    Raises:
        InputError: `config.json` is missing or does not name the folder, or the folder does not exist.
    """
    file = run / "config.json"
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
    values = read_json(file, fix) if file.suffix.lower() == ".json" else _read_yaml(file, fix)
    if isinstance(values, dict) and "config" in values:  # a run's file, which also names versions and data
        values = values["config"]
    if not isinstance(values, dict):
        raise input_error(file, "named fields of the config", type(values).__name__, fix)
    return config_of(_merged(to_dict(base), values), file)


def config_of(values: Any, file: Path) -> Config:
    """The config that was read from a file; fields that the file does not have get their default.

    Raises:
        InputError: names file and field.
    """
    try:
        return config_from(values)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _read_yaml(file: Path, fix: str) -> Any:
    try:
        return load_yaml(read_text(file, "a config", fix))
    except yaml.YAMLError as error:
        raise input_error(file, "YAML", " ".join(str(error).split())[:120], fix) from None


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """`base` with the entries of `changes`; dicts in both are merged."""
    both = {key for key in changes if isinstance(base.get(key), dict) and isinstance(changes[key], dict)}
    return base | {key: _merged(base[key], value) if key in both else value for key, value in changes.items()}
