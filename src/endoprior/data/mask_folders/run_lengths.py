"""Masks from run lengths: of CVAT (row by row in a box), and of COCO (column by column, also packed into text)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..reading import MOST_PIXELS


def mask_of_runs(runs: Sequence[int], num_pixels: int) -> NDArray[np.bool_]:
    """(num_pixels,) from lengths of runs that are outside, inside, outside, ... of an object.

    Raises:
        ValueError: a negative length, or lengths that do not fill the mask.
    """
    lengths = np.asarray(runs, np.int64)
    if num_pixels > MOST_PIXELS or lengths.ndim != 1:
        raise ValueError(f"run lengths of {num_pixels} px")
    # Each alone, too: the sum of huge numbers can wrap around.
    if ((lengths < 0) | (lengths > num_pixels)).any() or int(lengths.sum()) != num_pixels:
        raise ValueError(f"run lengths of {int(lengths.sum())} px for {num_pixels} px")
    return np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)


def mask_of_coco(counts: str | Sequence[int], size: Sequence[int]) -> NDArray[np.bool_]:
    """(H, W) from COCO's run lengths.

    Args:
        counts: lengths, or the text that holds them.
        size: height, width.
    Raises:
        ValueError: as `mask_of_runs`, or the text is cut off.
    """
    height, width = (int(side) for side in size)
    runs = _unpacked(counts) if isinstance(counts, str) else list(counts)
    return mask_of_runs(runs, height * width).reshape(width, height).T


def _unpacked(text: str) -> list[int]:
    """Lengths from text: 5 bits a character, lowest first; from the fourth on, differences to the one before last."""
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64:
            raise ValueError(f"the character {character!r} in run lengths")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:  # negative: the bits above are ones
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("run lengths that are cut off")
    return runs
