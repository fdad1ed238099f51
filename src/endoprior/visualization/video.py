"""Write videos with imageio's bundled ffmpeg."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain, islice
from pathlib import Path

import av
import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from ..data.video_files import open_container
from ..system.atomic import whole_file

HD_ROWS = 720
"""From so many rows on, players take a video for BT.709 where it does not say its colors, below for BT.601."""


def write_video(path: Path, images: Iterable[NDArray[np.uint8]], frames_per_second: float) -> None:
    """Write an H.264 mp4, atomically. It says how its colors are stored, and can be played while it loads.

    Args:
        images: (H, W, 3) 8-bit RGB, one size; an odd last row or column is cropped, because the codec needs even sizes.
    """
    with whole_file(path) as temporary:
        images = iter(images)
        first = list(islice(images, 1))
        matrix, tag = ("bt709", "bt709") if first and len(first[0]) >= HD_ROWS else ("bt601", "smpte170m")
        tags = f"setparams=range=tv:colorspace={tag}:color_primaries={tag}:color_trc={tag}"
        colors = ["-vf", f"scale=out_color_matrix={matrix}:out_range=tv,{tags}"]
        options = {"fps": frames_per_second, "codec": "libx264", "quality": 8, "macro_block_size": 1}
        options["output_params"] = [*colors, "-movflags", "+faststart"]
        count = 0
        with imageio.get_writer(str(temporary), format="FFMPEG", ffmpeg_log_level="quiet", **options) as writer:
            for image in chain(first, images):
                height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
                writer.append_data(np.ascontiguousarray(image[:height, :width]))
                count += 1
        if num_frames(temporary) != count:  # imageio does not check the exit status of the encoder
            raise BrokenPipeError(f"{path}: the encoder stopped before the end")


def num_frames(path: Path) -> int:
    """Number of frames of a video whose bytes are all there; 0 if the file is not a video."""
    try:
        with open_container(path) as video:
            return sum(packet.size > 0 and not packet.is_corrupt for packet in video.demux(video=0))
    except (av.FFmpegError, OSError, IndexError):
        return 0
