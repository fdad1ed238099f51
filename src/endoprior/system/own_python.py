"""Start a Python of ours. Nothing else in this program does."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

SAFE_PATH = "PYTHONSAFEPATH"
"""As `-P`, for all Python processes."""


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module of this program.

    With `-P`, a file in the current folder, which may have come with the data, is not imported in place of a package.
    """
    return [sys.executable, "-P", "-m", module, *arguments]


@contextmanager
def without_current_folder() -> Iterator[None]:
    """Python processes that libraries start in this block do not import files of the current folder either."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        os.environ.pop(SAFE_PATH)
        if before is not None:
            os.environ[SAFE_PATH] = before
