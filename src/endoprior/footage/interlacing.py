"""Detect interlaced images that their file does not flag as such: even and odd rows were taken at different times.

Of two successive images, the odd rows of the first and the even rows of the second are then closer in time than the
even rows of the first and the odd rows of the second, or the other way round. In progressive images both pairs are
equally far apart, whatever moves and however it was coded.

Where a fine texture moves so fast that all four are equally unlike, nearly every block of an image alternates from row
to row. So do the dots of a dithered GIF, but these alternate from column to column as well.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_operations import Image

Levels = NDArray[np.float32]  # gray values, 0 to 255
BLOCK_PX, MIN_BLOCKS = 16, 8
MIN_MOTION = 1.0  # mean difference of a block between two images, levels of 255, above which something moves in it
UNEQUAL = 0.06
"""Least median of `unequal_rows`, without its sign. Progressive clips, dithered too, have up to 0.02; woven ones 0.15
or more, and 0.12 or more if every second image is left out.
"""
MIN_DIFFERENCE = 3.0  # mean difference of neighboring rows, levels of 255, above which a block has structure
ALTERNATING = 1.3  # such a block alternates if rows next to each other differ more than rows two apart, by this factor
ROWS_ALONE = 2.0  # and that factor is so many times the same one of columns
COMBED_SHARE = 0.5  # least share of alternating blocks, of those with structure; dithered images have up to 0.18
COMBED_IMAGES = 0.1  # least share of images with so many of them
MIN_PAIRS, MAX_PAIRS = 3, 24  # pairs of images that are compared


class Interlacing:
    """Collects evidence over all images of a clip, in their order; of many, a part is compared."""

    def __init__(self) -> None:
        self._before: Image | None = None
        self._count, self._every = 0, 1
        self._found: list[tuple[float | None, bool]] = []  # `unequal_rows` and `is_combed` of each pair

    def see(self, image: Image) -> None:
        """The next image (H, W, 3)."""
        if self._before is not None:
            if self._count % self._every == 0:
                before, now = _gray(self._before), _gray(image)
                self._found.append((unequal_rows(before, now), is_combed(now)))
            if len(self._found) == MAX_PAIRS:
                self._found, self._every = self._found[::2], 2 * self._every
            self._count += 1
        self._before = image

    @property
    def is_certain(self) -> bool:
        """Whether the images seen so far are interlaced."""
        unequal = [each for each, _ in self._found if each is not None]
        if len(unequal) >= MIN_PAIRS and abs(float(np.median(unequal))) > UNEQUAL:
            return True
        return sum(combed for _, combed in self._found) > COMBED_IMAGES * len(self._found)


def unequal_rows(before: Levels, now: Levels) -> float | None:
    """Log of how much further even rows are from odd ones than odd from even ones, of two successive images (H, W).

    None where nothing moves. Each row is compared with the mean of those above and below its place.
    """
    if not before.size:
        return None
    moves = _of_blocks(cv2.absdiff(before, now)[1:-1]) > MIN_MOTION
    if np.count_nonzero(moves) < MIN_BLOCKS:
        return None
    apart = cv2.absdiff(before[1:-1], (now[:-2] + now[2:]) / 2)
    odd, even = (float(_of_blocks(apart[first::2], BLOCK_PX // 2)[moves].mean()) for first in (0, 1))
    return float(np.log(max(even, 1e-3) / max(odd, 1e-3)))


def is_combed(levels: Levels) -> bool:
    """Whether most parts of an image (H, W) alternate from row to row, and not from column to column."""
    if not levels.size:
        return False
    inner = levels[:-2]
    rows, rows_apart = (_of_blocks(cv2.absdiff(levels[by : by - 2 or None], inner)) for by in (1, 2))
    columns, columns_apart = (_of_blocks(cv2.absdiff(inner[:, by:], inner[:, :-by])) for by in (1, 2))
    is_structured, is_of_rows = rows > MIN_DIFFERENCE, rows * columns_apart > ROWS_ALONE * columns * rows_apart
    combed = is_structured & is_of_rows & (rows > ALTERNATING * rows_apart)
    return bool(combed.sum() >= max(MIN_BLOCKS, COMBED_SHARE * is_structured.sum()))


def _gray(image: Image) -> Levels:
    """(H, W) of an image (H, W, 3): whole blocks, and two rows more; empty if it has none."""
    rows, columns = (image.shape[0] - 2) // BLOCK_PX, image.shape[1] // BLOCK_PX
    if min(rows, columns) < 1:
        return np.zeros((0, 0), np.float32)
    part = image[: rows * BLOCK_PX + 2, : columns * BLOCK_PX]
    return np.asarray(cv2.cvtColor(part, cv2.COLOR_RGB2GRAY), np.float32)


def _of_blocks(values: NDArray, height: int = BLOCK_PX) -> Levels:
    """Means of blocks of `height` rows. Where one or two columns are missing, the blocks are a little narrower."""
    size = round(values.shape[1] / BLOCK_PX), values.shape[0] // height
    return np.asarray(cv2.resize(np.ascontiguousarray(values), size, interpolation=cv2.INTER_AREA), np.float32)
