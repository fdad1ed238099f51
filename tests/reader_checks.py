"""What tests of readers share: errors in one line, and frames compared with what was written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence


def assert_rejected(folder: Path, named: str, words: str, cfg: DataConfig | None = None) -> None:
    """Loading, or decoding every frame, must fail with one line: PATH: expected X, got Y. Next step."""
    with pytest.raises(InputError) as caught:
        load_sequence(folder, cfg).validate()
    message = str(caught.value)
    path, rest = message.split(": expected ", 1)
    assert path.endswith(named) and path.startswith(str(folder)), message
    assert words in message, message
    assert ", got " in rest and "\n" not in message and message.endswith(".") and rest.count(". ") >= 1, message


def assert_damage_is_rejected(folder: Path, damage: Callable[[Path], object], named: str, words: str) -> None:
    """As `assert_rejected`, once `damage` has changed the folder."""
    damage(folder)
    assert_rejected(folder, named, words)


def remark_with(folder: Path, words: str, cfg: DataConfig | None = None) -> bool:
    """Whether a remark of the validated sequence contains `words`."""
    remarks = load_sequence(folder, cfg).validate()
    assert all("\n" not in remark for remark in remarks)
    return any(words in remark for remark in remarks)


def edit_json(path: Path, **changes: object) -> None:
    """Change keys of a JSON file; None removes one."""
    stored = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in stored.items() if value is not None}))
