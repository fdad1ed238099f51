"""Whether a folder holds the run that is to be resumed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..core.checks import InputError
from ..core.config import Config
from ..core.config_io import current_value, to_dict


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
    current = json.loads(json.dumps(to_dict(cfg)))
    if changed := _first_difference(stored_config if isinstance(stored_config, dict) else {}, current):
        raise InputError(f"{file}: config differs at {changed}. Resume with the options the run was started with.")
    if stored_fingerprint != fingerprint:
        raise InputError(f"{file}: was trained on other data than {data}. Pass the same sequence.")


def _first_difference(old: dict, new: dict, where: str = "") -> str:
    """Path and both values of the first field that differs."""
    for name, value in new.items():
        if isinstance(value, dict) and isinstance(old.get(name), dict):
            if found := _first_difference(old[name], value, f"{where}{name}."):
                return found
        elif name not in old or value != current_value(f"{where}{name}", old[name]):
            return f"{where}{name} ({old.get(name)!s:.80} in the folder, {value!s:.80} now)"
    return next((f"{where}{name:.80} (unknown to this version)" for name in old if name not in new), "")
