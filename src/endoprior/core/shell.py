"""Commands as text that a user can paste into the shell, and the options and packages that they name."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import requires
from pathlib import Path
from typing import Any

from packaging.markers import Marker
from packaging.requirements import Requirement

SAFE_ON_WINDOWS = re.compile(r"[\w@+=:,./\\-]+", re.ASCII)
"""Words that neither cmd.exe nor PowerShell changes."""


def command(name: str, *words: str | Path) -> str:
    """The command `endoprior NAME WORDS...`, quoted for the shell of this system.

    Placeholders such as `OUT` are words like any other. A path that starts with a dash gets `./` in front, so that
    it is not read as an option.

    Args:
        name: the command, `train` for instance.
        words: options as strings, files and folders as paths.
    """
    return " ".join(["endoprior", name, *(quoted(_not_an_option(word)) for word in words)])


def quoted(word: str | Path) -> str:
    """One word of a command, in quotes if the shell would change it."""
    text = os.fspath(word)
    if os.name != "nt":
        return shlex.quote(text)
    if SAFE_ON_WINDOWS.fullmatch(text):
        return text
    # A file name has no double quotes on Windows. A backslash before the closing one would escape it.
    return f'"{text}{chr(92) if text.endswith(chr(92)) else ""}"'


def _not_an_option(word: str | Path) -> str | Path:
    if isinstance(word, Path) and os.fspath(word).startswith("-"):
        return os.path.join(os.curdir, os.fspath(word))
    return word


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


@cache
def install_command(extra: str) -> str:
    """The command that installs the packages of an optional part: `pip install -c constraints.txt torchvision lpips`.

    It names the packages, because the program itself need not be on a package index. The constraints keep torch as it
    is; gsplat is installed without them, because it fits every torch and a GPU may need another version than theirs.

    Args:
        extra: a name of `[project.optional-dependencies]`, `networks` for instance.
    """
    names = packages_of(extra)
    if not names:  # the installation is older than the program: a checkout that was updated since
        return f"pip install -c constraints.txt '.[{extra}]'"
    return " ".join(["pip install", *([] if extra == "cuda" else ["-c constraints.txt"]), *names])


def packages_of(extra: str) -> list[str]:
    """The packages of an optional part, as the installation lists them."""
    listed = [Requirement(line) for line in requires("endoprior") or ()]
    return [each.name for each in listed if each.marker and _wants(each.marker, extra)]


def missing_package(package: str, extra: str, error: ImportError) -> str:
    """One sentence about a package of an optional part that is not installed or cannot be imported, and the fix."""
    is_absent = isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] == package
    reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
    state = "is not installed" if is_absent else f"cannot be imported ({reason})"
    return f"{package} {state}. Fix: `{install_command(extra)}`."


def _wants(marker: Marker, extra: str) -> bool:
    """Whether a requirement belongs to this extra, rather than to every installation on such a system."""
    return marker.evaluate({"extra": extra}) and not marker.evaluate({"extra": ""})
