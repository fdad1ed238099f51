"""Films, through imageio's bundled ffmpeg."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import av
import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from ..system.atomic import whole_file


def write_video(path: Path, pictures: Iterable[NDArray[np.uint8]], frames_per_second: float) -> None:
    """Write an H.264 mp4, whole or not at all.

    Args:
        pictures: (H, W, 3) 8-bit RGB, one size; an odd last row or column is cut, as the codec demands even sizes.
    """
    with whole_file(path) as temporary:
        options = {"fps": frames_per_second, "codec": "libx264", "quality": 8, "macro_block_size": 1}
        count = 0
        with imageio.get_writer(str(temporary), format="FFMPEG", ffmpeg_log_level="quiet", **options) as writer:
            for picture in pictures:
                height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
                writer.append_data(np.ascontiguousarray(picture[:height, :width]))
                count += 1
        if _num_frames(temporary) != count:  # nobody asks the encoder how it ended
            raise BrokenPipeError(f"{path}: the encoder stopped before the end")


def _num_frames(path: Path) -> int:
    """Frames of a film by its own table, which is written last; 0 for what is no film."""
    try:
        with av.open(str(path)) as film:
            return film.streams.video[0].frames
    except (av.FFmpegError, OSError, IndexError):
        return 0
