"""Every folder layout that can be opened. To add one, write a module with a `FORMAT` here and name it in `FORMATS`.

docs/datasets.md describes each layout, and shows how to add one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.config import DataConfig

if TYPE_CHECKING:
    from .sequence import FrameSequence

FORMATS = (
    "scared",
    "c3vd",
    "stir",
    "stereomis",  # before EndoNeRF, whose layout it extends
    "hamlyn",  # likewise
    "endonerf",
    "plain",  # last: it recognizes every folder with images
)
"""Modules of this package by the name that `DataConfig.format` takes, in the order in which `auto` tries them."""


@dataclass(frozen=True)
class Format:
    """One folder layout."""

    recognizes: Callable[[Path], bool]
    """Whether a folder has this layout, by the names in it alone."""
    load: Callable[[Path, DataConfig], FrameSequence]
    """Opens a folder; raises InputError where it cannot be used."""


def load_format(name: str) -> Format:
    """The layout of that name in `FORMATS`; imports its module."""
    return import_module(f".{name}", __package__).FORMAT
