"""Every folder layout that can be opened. To add one, write a module with a `FORMAT` here and name it in `FORMATS`.

docs/datasets.md describes each layout, and shows how to add one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ..core.config import DataConfig
from ..system.plugins import Registry, report
from .image_folders import has_depth
from .sequence import FrameSequence

FORMATS = (
    "scared",
    "c3vd",
    "stir",
    "stereomis",  # before EndoNeRF, whose layout it extends
    "hamlyn",  # likewise
    "no_depth",
    "nerfstudio",
    "colmap",
    "endonerf",
    "plain",  # last: it recognizes every folder with images
)
"""Modules of this package by the name that `DataConfig.format` takes, in the order in which `auto` tries them."""
IN_ENDONERF = ("stereomis", "no_depth", "plain")  # names in its module: layouts that have more or less than EndoNeRF's


@dataclass(frozen=True)
class DatasetFormat:
    """One folder layout."""

    recognizes: Callable[[Path], bool]  # whether a folder has this layout, by the names in it alone
    load: Callable[[Path, DataConfig], FrameSequence]  # opens a folder; InputError where it cannot be used


def _problem(found: Any) -> str:
    return "" if isinstance(found, DatasetFormat) else f"an object of type {type(found).__name__}"


def _load(name: str) -> DatasetFormat:
    if name in IN_ENDONERF:
        return getattr(import_module(".endonerf", __package__), name.upper())
    return import_module(f".{name}", __package__).FORMAT


REGISTRY: Registry[DatasetFormat] = Registry(
    "datasets",
    "a DatasetFormat of endoprior.data.formats",
    _problem,
    modules=FORMATS,
    load_module=_load,
    reserved=("auto",),
)
"""The layouts above, and those of plugins."""


def recognizing(path: Path) -> str | None:
    """Name of the first layout that recognizes a folder; plugins come after the built-in layouts, before `plain`."""
    for name in FORMATS[:-1]:
        if REGISTRY.load(name).recognizes(path):
            return name
    for name, layout in REGISTRY.usable():
        try:
            if layout.recognizes(path):
                return name
        except Exception as error:  # a plugin's fault must not keep other folders from opening
            report(REGISTRY.failure(name, error))
    return FORMATS[-1] if REGISTRY.load(FORMATS[-1]).recognizes(path) else None


def needs_depth(folder: Path) -> bool:
    """Whether a folder has images, and neither depth nor poses: `prepare` makes a sequence of it."""
    return recognizing(folder) == "plain" and not has_depth(folder)
