"""Commands as text that a user can paste into the shell."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

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
