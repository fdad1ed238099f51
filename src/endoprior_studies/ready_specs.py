"""The specs that come with the program. `endoprior bench` takes them by name: `quick`, `sized`, `sized/growth`."""

from __future__ import annotations

from pathlib import Path

from endoprior.core.checks import input_error

FOLDER = Path(__file__).parent / "specs"
SUFFIXES = (".yaml", ".yml", ".toml")


def spec_names() -> list[str]:
    """Names of the specs, and of the folders of specs, that come with the program."""
    files = [path.relative_to(FOLDER).with_suffix("") for path in _specs(FOLDER, "**/*")]
    folders = {path.parent for path in files} - {Path()}
    return sorted(path.as_posix() for path in {*files, *folders})


def find_spec(name_or_path: str) -> Path:
    """The file or folder of a name or path.

    Args:
        name_or_path: a name wins over a path: with a folder `quick` of your own, write `./quick`.
    Raises:
        InputError: neither a name nor a path that exists.
    """
    names = spec_names()
    if name_or_path in names:
        folder = FOLDER / name_or_path
        return folder if folder.is_dir() else folder.with_suffix(".yaml")
    if not Path(name_or_path).exists():
        raise input_error(name_or_path, f"a file, a folder or one of {', '.join(names)}", "neither", "correct SPEC.")
    return Path(name_or_path)


def specs_of(path: Path) -> list[Path]:
    """The spec itself, or those of a folder, sorted by name.

    Raises:
        InputError: the folder holds no specs.
    """
    if not path.is_dir():
        return [path]
    if specs := _specs(path, "*"):
        return specs
    raise input_error(path, ".yaml or .toml files", "none", "Pass a folder of specs.")


def _specs(folder: Path, pattern: str) -> list[Path]:
    """Spec files. One that starts with `_` is only there to be extended."""
    return sorted(path for path in folder.glob(pattern) if path.suffix in SUFFIXES and path.name[0] != "_")
