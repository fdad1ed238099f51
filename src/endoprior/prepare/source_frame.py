"""One image of a video file or image folder, with its time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SourceFrame:
    """One image of a source."""

    index: int
    """Position in the source, from 0."""
    seconds: float
    """Time since the first image. It may be before that of the image before, if the file has its times in disorder."""
    rgb_u8: NDArray[np.uint8]
    """(H, W, 3) of square pixels."""
    damaged: bool = False
    """Bytes of it, or of an image that it was predicted from, are missing or wrong."""
