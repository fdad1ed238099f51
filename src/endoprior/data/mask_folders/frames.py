"""What every format of a user's masks becomes: one mask per frame, read when it is needed. `H, W` image size."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.checks import input_error
from ..file_names import sorting_keys
from ..mask_files import read_user_mask
from ..mask_values import HighValues

Mask = NDArray[np.bool_]
Size = tuple[int, int]
"""(width, height), px."""


@dataclass(frozen=True)
class MaskFrame:
    """The mask of one frame."""

    name: str
    """File name that holds the name or the number of the frame."""
    read: Callable[[Size], Mask]
    """(H, W) True where the value is high. Raises InputError if it is unreadable or has another size."""


@dataclass(frozen=True)
class MaskFolder:
    """The masks of a clip, as a program wrote them."""

    frames: Sequence[MaskFrame]
    """In natural order."""
    note: str = ""
    """What was recognized, and which labels are tools; empty for plain files."""
    tool_is_high: bool | None = None
    """Whether high values mark tools; None where the format does not tell."""
    in_order_only: bool = False
    """The numbers in the names are not those of frames: masks belong to frames in order, if there are as many."""


def sorted_frames(frames: Sequence[MaskFrame]) -> list[MaskFrame]:
    """The frames in natural order of their names."""
    keys = sorting_keys([Path(frame.name).stem for frame in frames])
    return [frames[i] for i in sorted(range(len(frames)), key=keys.__getitem__)]


def union_of_files(files: Sequence[Path], rule: HighValues | None = None) -> Callable[[Size], Mask]:
    """Reads the union of some mask files; of none, an empty mask. Args: rule: as `read_user_mask`."""

    def read(size: Size) -> Mask:
        return union((read_user_mask(file, size, rule) for file in files), size)

    return read


def union(masks: Iterable[Mask], size: Size) -> Mask:
    """(H, W) True where any of the masks is."""
    return np.any([np.zeros(size[::-1], bool), *masks], axis=0)


def demand_size(subject: Path | str, got: Size, size: Size) -> None:
    """Raise InputError unless a mask has the size of the frames."""
    if got != size:
        want = f"{size[0]}x{size[1]} px like the images"
        raise input_error(subject, want, f"{got[0]}x{got[1]}", "Export masks at the size of the images.")
