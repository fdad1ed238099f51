"""Places to write to, looked at before work begins that would be lost there."""

from __future__ import annotations

import tempfile
from pathlib import Path

from ..core.checks import InputError
from ..data.reading import kind_of


def demand_file_place(option: str, path: Path, keep: Path) -> None:
    """Refuse a place where no file can be written, and a file of the input.

    Args:
        option: the option that names it.
        path: of the file to write; one that is there is replaced.
        keep: the folder that is read, whose files must stay as they are.
    Raises:
        InputError: naming option and path.
    """
    kind = kind_of(path)
    if kind not in ("a file", "nothing"):
        raise InputError(f"{option} {path}: expected a place for a file; got {kind}. Choose another name.")
    if kind == "a file" and keep.resolve() in path.resolve().parents:
        raise InputError(f"{option} {path}: expected a place outside of {keep}; got a file of it. Choose another name.")
    _demand_writable(option, path, path.absolute().parent)


def demand_folder_place(option: str, path: Path) -> None:
    """Refuse a place where no folder is or can be made; see `demand_file_place`."""
    kind = kind_of(path)
    if kind not in ("a folder", "nothing"):
        raise InputError(f"{option} {path}: expected a place for a folder; got {kind}. Choose another name.")
    _demand_writable(option, path, path.absolute())


def _demand_writable(option: str, path: Path, folder: Path) -> None:
    """Try a nameless file in the nearest folder above that exists."""
    while kind_of(folder) == "nothing" and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        got = f"{error.strerror} at {folder}"
        raise InputError(f"{option} {path}: expected a place to write to; got {got}. Choose another.") from None
