"""Films, through imageio's bundled ffmpeg."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from ..atomic import whole_file


def write_video(path: Path, pictures: Iterable[NDArray[np.uint8]], frames_per_second: float) -> None:
    """Write an H.264 mp4, whole or not at all.

    Args:
        pictures: (H, W, 3) 8-bit RGB, one size; an odd last row or column is cut, as the codec demands even sizes.
    """
    with whole_file(path) as temporary:
        options = {"fps": frames_per_second, "codec": "libx264", "quality": 8, "macro_block_size": 1}
        with imageio.get_writer(str(temporary), format="FFMPEG", **options) as writer:
            for picture in pictures:
                height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
                writer.append_data(np.ascontiguousarray(picture[:height, :width]))
