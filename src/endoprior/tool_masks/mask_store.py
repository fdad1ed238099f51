"""Masks that are being made, one small PNG per frame, and what has been done, so that the search can be resumed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..core.checks import InputError
from ..core.config_io import value_of
from ..data.found_tools import FrameRow
from ..data.images import read_tool_mask, write_tool_mask
from ..footage.image_operations import Mask
from ..system.atomic import read_json_object, write_json

STATE = "state.json"
TYPES = {"rows": tuple[FrameRow, ...], "confidence": tuple[float, ...], "carried": tuple[str, ...]}
"""What it holds by name; any other name is a list of `PROMPTS`."""
PROMPTS = tuple[tuple[int, int, int], ...]


class MaskStore(Mapping[int, Mask]):
    """Masks by frame; `mask` gives an empty one where none was written."""

    def __init__(self, folder: Path, size: tuple[int, int]) -> None:
        """Args: folder: made if needed. size: (width, height), px."""
        self.folder, self._shape = folder, size[::-1]
        folder.mkdir(parents=True, exist_ok=True)

    def __getitem__(self, index: int) -> Mask:
        file = self._file(index)
        if not file.exists():
            raise KeyError(index)
        return read_tool_mask(file)

    def __iter__(self) -> Iterator[int]:
        return iter(sorted(int(file.stem) for file in self.folder.glob("*.png")))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def mask(self, index: int) -> Mask:
        """(H, W) the mask of a frame; empty if none was written."""
        return self[index] if self._file(index).exists() else np.zeros(self._shape, bool)

    def put(self, index: int, mask: Mask) -> None:
        """Write the mask (H, W) of a frame."""
        write_tool_mask(self._file(index), mask)

    def add(self, index: int, mask: Mask) -> None:
        """Add the pixels of a mask (H, W) to that of a frame. To add them twice changes nothing."""
        if mask.any():
            self.put(index, self.mask(index) | mask)

    def _file(self, index: int) -> Path:
        return self.folder / f"{index:06d}.png"


def read_state(folder: Path) -> dict[str, Any]:
    """What an interrupted run has done; empty before the first, and where the file is damaged: all is done again."""
    stored = read_json_object(folder / STATE) or {}
    try:
        return {name: value_of(TYPES.get(name, PROMPTS), value, name) for name, value in stored.items()}
    except InputError:
        return {}


def write_state(folder: Path, state: dict[str, Any]) -> None:
    """Note what has been done."""
    write_json(folder / STATE, state)
