"""Every folder layout that can be opened. To add one, write a module with a `Format` here and name it in `FORMATS`.

docs/datasets.md describes each layout, and shows how to add one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.config import DataConfig
from ..system.plugins import Registry, report

if TYPE_CHECKING:
    from .sequence import FrameSequence

FORMATS = {
    "scared": "scared.FORMAT",
    "c3vd": "c3vd.FORMAT",
    "stir": "stir.FORMAT",
    "stereomis": "stereomis.FORMAT",  # before EndoNeRF, whose layout it extends
    "hamlyn": "hamlyn.FORMAT",  # likewise
    "no_depth": "endonerf.NO_DEPTH",
    "nerfstudio": "nerfstudio.FORMAT",
    "colmap": "colmap.FORMAT",
    "endonerf": "endonerf.FORMAT",
    "plain": "endonerf.PLAIN",  # last: it recognizes every folder with images
}
"""Module and name of each layout that `DataConfig.format` takes, in the order in which `auto` tries them."""


@dataclass(frozen=True)
class Format:
    """One folder layout."""

    recognizes: Callable[[Path], bool]
    """Whether a folder has this layout, by the names in it alone."""
    load: Callable[[Path, DataConfig], FrameSequence]
    """Opens a folder; raises InputError where it cannot be used."""


def _problem(found: Any) -> str:
    return "" if isinstance(found, Format) else f"an object of type {type(found).__name__}"


def _load(name: str) -> Format:
    module, _, attribute = FORMATS[name].partition(".")
    return getattr(import_module(f".{module}", __package__), attribute)


REGISTRY: Registry[Format] = Registry(
    "datasets",
    "a Format of endoprior.data.formats",
    _problem,
    modules=tuple(FORMATS),
    load_module=_load,
    reserved=("auto",),
)
"""The layouts above, and those of plugins."""


def recognizing(path: Path) -> str | None:
    """Name of the first layout that recognizes a folder; plugins come after the built-in layouts, before `plain`."""
    *first, last = FORMATS
    for name in first:
        if REGISTRY.load(name).recognizes(path):
            return name
    for name, layout in REGISTRY.usable():
        try:
            if layout.recognizes(path):
                return name
        except Exception as error:  # a plugin's fault must not keep other folders from opening
            report(REGISTRY.failure(name, error))
    return last if REGISTRY.load(last).recognizes(path) else None
