"""The layouts that can be opened, in the order in which they are tried; docs/datasets.md describes each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..core.config import DataConfig
from .c3vd import is_c3vd, load_c3vd
from .endonerf import is_endonerf, load_endonerf
from .hamlyn import is_hamlyn, load_hamlyn
from .plain import is_plain, load_plain
from .scared import is_scared, load_scared
from .sequence import FrameSequence
from .stereomis import is_stereomis, load_stereomis
from .stir import is_stir, load_stir


class Format(NamedTuple):
    """One layout of a dataset folder."""

    name: str
    """Its name in `DataConfig.format`."""
    recognizes: Callable[[Path], bool]
    """Whether a folder looks like it, by the names in it alone."""
    load: Callable[[Path, DataConfig], FrameSequence]
    """Opens the folder, or raises InputError."""


FORMATS = (
    Format("scared", is_scared, load_scared),
    Format("c3vd", is_c3vd, load_c3vd),
    Format("stir", is_stir, load_stir),
    # StereoMIS and Hamlyn before EndoNeRF, whose layout they extend; plain folders last, they promise least.
    Format("stereomis", is_stereomis, load_stereomis),
    Format("hamlyn", is_hamlyn, load_hamlyn),
    Format("endonerf", is_endonerf, load_endonerf),
    Format("plain", is_plain, load_plain),
)
