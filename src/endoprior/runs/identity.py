"""Whether a folder holds the run that is to be resumed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..core.checks import InputError
from ..core.config import Config
from ..core.config_io import to_dict
from ..core.shell import command
from ..data.files import read_json
from .stored_run import config_of


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
        InputError: the config differs, or the data do.
    """
    reject_other_config(file, config_of(stored_config, file), cfg)
    if stored_fingerprint != fingerprint:
        raise InputError(f"{file}: was trained on other data than {data}. Fix: Pass the same sequence.")


def reject_other_start(about: Path, cfg: Config, fingerprint: str, data: Path) -> None:
    """`reject_other_run` for what `config.json` (`about`) says."""
    stored = read_json(about)
    facts = stored.get("data")
    known = facts.get("fingerprint") if isinstance(facts, dict) else None
    reject_other_run(about, stored.get("config"), known, cfg, fingerprint, data)


def reject_other_config(file: Path, stored: Config, cfg: Config) -> None:
    """Raise InputError, with the names of all fields that differ, unless both configs are equal."""
    if changed := ", ".join(_differences(to_dict(stored), to_dict(cfg))):
        fix = f"`{command('train', '--resume', file.parent)}` takes the options of the folder"
        raise InputError(f"{file}: config differs at {changed}. Fix: {fix}; a new run needs a new folder.")


def _differences(old: dict[str, Any], new: dict[str, Any], where: str = "") -> Iterator[str]:
    """Each field that differs, with both values."""
    for name, value in new.items():
        if isinstance(value, dict) and isinstance(old[name], dict):
            yield from _differences(old[name], value, f"{where}{name}.")
        elif value != old[name]:
            yield f"{where}{name} ({old[name]!s:.80} in the folder, {value!s:.80} now)"
