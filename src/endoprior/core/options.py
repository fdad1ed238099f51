"""The fields of a config as options of the command line, in the spelling of tyro."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from .shell import command

Options = dict[str, tuple[str, ...]]
"""Name of an option, with its dashes, and the words after it: `{"--crop": ("0,0,640,500",), "--swap-eyes": ()}`."""


def changed_options(cfg: Any, prefix: str = "") -> Options:
    """The options that give the values of a config dataclass which differ from its defaults.

    Args:
        prefix: of the names, such as `data.`.
    """
    options: Options = {}
    default = type(cfg)()
    for field in fields(cfg):
        value, name = getattr(cfg, field.name), field.name.replace("_", "-")
        if is_dataclass(value):
            options |= changed_options(value, f"{prefix}{name}.")
        elif value != getattr(default, field.name):
            options[f"--{prefix}{'no-' if value is False else ''}{name}"] = _words(value)
    return options


def command_of(name: str, places: tuple[str | Path, ...], options: Mapping[str, tuple[str, ...]]) -> str:
    """The command `endoprior NAME PLACES... OPTIONS...`, quoted for the shell."""
    return command(name, *places, *(word for option, words in options.items() for word in (option, *words)))


def _words(value: Any) -> tuple[str, ...]:
    if isinstance(value, bool):
        return ()
    if isinstance(value, tuple | list):
        return tuple(word for part in value for word in _words(part))
    return (os.path.abspath(value) if isinstance(value, Path) else str(value),)
