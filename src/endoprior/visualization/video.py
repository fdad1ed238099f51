"""Write videos with imageio's bundled ffmpeg."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import av
import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from ..system.atomic import whole_file


def write_video(path: Path, images: Iterable[NDArray[np.uint8]], frames_per_second: float) -> None:
    """Write an H.264 mp4, atomically.

    Args:
        images: (H, W, 3) 8-bit RGB, one size; an odd last row or column is cropped, because the codec needs even sizes.
    """
    with whole_file(path) as temporary:
        options = {"fps": frames_per_second, "codec": "libx264", "quality": 8, "macro_block_size": 1}
        count = 0
        with imageio.get_writer(str(temporary), format="FFMPEG", ffmpeg_log_level="quiet", **options) as writer:
            for image in images:
                height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
                writer.append_data(np.ascontiguousarray(image[:height, :width]))
                count += 1
        if num_frames(temporary) != count:  # imageio does not check the exit status of the encoder
            raise BrokenPipeError(f"{path}: the encoder stopped before the end")


def num_frames(path: Path) -> int:
    """Number of frames in the table of a video, which is written last; 0 if the file is not a complete video."""
    try:
        with av.open(str(path)) as video:
            return video.streams.video[0].frames
    except (av.FFmpegError, OSError, IndexError):
        return 0
