"""The installed program: which commit it is, and where its documentation lies."""

from __future__ import annotations

import subprocess
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
ADDRESS = "https://jiaqi-huang-77.github.io/EndoPrior-GS/"
"""The project in the web."""
STAMP = PACKAGE / "commit.txt"
"""Written when a package is built (setup.py); a checkout has none."""


def source_commit() -> str | None:
    """Commit the program was built from, or of the checkout it runs from; None if neither is known.

    A `+` at the end says that files differed from it.
    """
    if STAMP.is_file():
        return STAMP.read_text(encoding="utf-8").strip()
    try:
        # An installed package can lie inside somebody else's checkout: only a tracked file speaks for its repository.
        _git("ls-files", "--error-unmatch", __file__)
        return _git("describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(*words: str) -> str:
    options = {"cwd": PACKAGE, "capture_output": True, "timeout": 10, "check": True}
    return subprocess.run(["git", *words], encoding="utf-8", **options).stdout.strip()


def docs_folder() -> Path:
    """The folder that messages call `docs/`: in the installed package, or in the checkout."""
    installed = PACKAGE / "docs"
    return installed if installed.is_dir() else PACKAGE.parents[1] / "docs"


def page(name: str) -> str:
    """Where the user finds a page of the documentation: its file, or the address of the project if there is none."""
    file = docs_folder() / name
    return str(file) if file.is_file() else ADDRESS
