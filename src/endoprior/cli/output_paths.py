"""Check that output paths are writable, before the work begins."""

from __future__ import annotations

from pathlib import Path

from ..core.checks import input_error
from ..data.reading import kind_of
from ..system.leftovers import temporary_sibling
from ..system.paths import lies_in


def require_writable_file(option: str, path: Path, keep: Path) -> None:
    """Reject a path that cannot be written, and files of the input folder.

    Args:
        option: the option that names the path.
        path: the file to write; an existing file is replaced.
        keep: the input folder, whose files must not change.
    Raises:
        InputError: names option and path.
    """
    kind = kind_of(path)
    if kind not in ("a file", "nothing"):
        raise input_error(f"{option} {path}", "the path of a file", kind, "Choose another name.")
    if kind == "a file" and lies_in(path, keep):
        raise input_error(f"{option} {path}", f"a path outside of {keep}", "a file in it", "Choose another name.")
    _require_writable(option, path, path.absolute().parent)


def require_new_file(path: Path) -> None:
    """Reject an existing file; the caller has an option --overwrite that permits it."""
    if kind_of(path) == "a file":
        raise input_error(path, "a new file", "one that exists", "Choose another name, or add --overwrite.")


def require_writable_folder(option: str, path: Path) -> None:
    """Reject a path where no folder can be created or written; see `require_writable_file`."""
    kind = kind_of(path)
    if kind not in ("a folder", "nothing"):
        raise input_error(f"{option} {path}", "the path of a folder", kind, "Choose another name.")
    _require_writable(option, path, path.absolute())


def _require_writable(option: str, path: Path, folder: Path) -> None:
    """Try to write a file in the nearest existing parent folder."""
    while kind_of(folder) == "nothing" and folder != folder.parent:
        folder = folder.parent
    try:
        # Not by `tempfile`: on Windows it tries two billion names if the folder is not writable.
        probe = temporary_sibling(folder / "writable")
        probe.touch()
        probe.unlink()
    except OSError as error:
        got = f"{error.strerror} at {folder}"
        raise input_error(f"{option} {path}", "a writable path", got, "Choose another path.") from None
