"""Every export format. To add one, write a module with a `FORMAT` in this folder and name it in `FORMATS`.

docs/export.md shows how; docs/format.md says what the files of each format hold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..system.plugins import Registry

if TYPE_CHECKING:
    from ..model.scene import Scene
    from .options import ExportOptions
    from .time_steps import TimeStep

Axes = Literal["opencv", "opengl", "ras", "lps"]
"""Axes that exported coordinates refer to; docs/format.md defines them."""
Progress = Callable[[int, int], None]
"""Takes how much is done and how much there is."""

FORMATS = (
    "ply",
    "compressed_ply",
    "sog",
    "splat",
    "spz",
    "gltf",
    "points",
    "mesh",
    "animation",
    "slicer",
    "cameras",
    "depth",
    "tracks",
    "measures",
    "video",
    "scene",
    "html",
)
"""Modules of this package by the name that --format takes, in the order of `endoprior export --help`."""
TIME_STEP_OPTIONS = ("times", "split", "frame")
"""Options of most formats that have a file for each time step."""


@dataclass(frozen=True)
class Format:
    """One export format: what it writes, and which options it takes. Either `files` or `write` is set."""

    suffixes: tuple[str, ...]
    """Suffixes of its files; empty for a `write` that makes a folder."""
    options: tuple[str, ...]
    """Fields of `ExportOptions` that the format uses; others are rejected."""
    files: Callable[[Scene, TimeStep, ExportOptions], dict[str, bytes]] | None = None
    """The contents of the files of one time step, by suffix."""
    write: Callable[[Scene, Path, ExportOptions, Progress], None] | None = None
    """Writes one output for the whole sequence."""
    suffix_option: str = ""
    """Field of `ExportOptions` that chooses between the suffixes, as `mesh_format`; by default the file's name does."""
    default_axes: Axes = "opencv"
    """What --frame stands for where it is not given."""
    holds: str = ""
    """What is in a file, in plain words: `a mesh`; `endoprior export` says it of what it wrote."""
    has_index: bool = True
    """Whether a folder of its files also holds `index.json`; False where each file says itself what it is."""
    note: Callable[[Scene, Path, ExportOptions], str] | None = None
    """What a user of the file must know, in one line; `endoprior export` says it."""
    index_facts: Mapping[str, Any] | None = None
    """What `index.json` says of the files' units, for a format without axes in mm."""


def _problem(found: Any) -> str:
    if not isinstance(found, Format):
        return f"an object of type {type(found).__name__}"
    has_one = (found.files is None) != (found.write is None)
    return "" if has_one else "a Format with both or none of files and write"


REGISTRY: Registry[Format] = Registry(
    "exporters",
    "a Format of endoprior.export.formats",
    _problem,
    modules=FORMATS,
    load_module=lambda name: import_module(f".{name}", __package__).FORMAT,
)
"""The formats above, and those of plugins."""


def load_format(name: str) -> Format:
    """The format of that name; imports its module.

    Raises:
        InputError: it is a plugin that cannot be used.
        ValueError: there is none.
    """
    if name not in REGISTRY.names():
        raise ValueError(f"format must be one of {', '.join(REGISTRY.names())}; got {name!r}")
    return REGISTRY.load(name)


def formats_of(suffix: str) -> list[str]:
    """Names of the formats that write files of this suffix: the one that it stands for first, plugins last."""
    return [name for name, format_ in _loaded() if suffix in format_.suffixes]


def known_suffixes() -> list[str]:
    """Every suffix that says a format, without repetition."""
    return list(dict.fromkeys(suffix for _, format_ in _loaded() for suffix in format_.suffixes))


def _loaded() -> list[tuple[str, Format]]:
    """Name and format of all that can be used, plugins last."""
    return [*((name, REGISTRY.load(name)) for name in FORMATS), *REGISTRY.usable()]
