"""Write videos."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from ..data.video_files import open_container
from ..system.atomic import whole_file

HD_ROWS = 720
"""From so many rows on, players take a video for BT.709 where it does not say its colors, below for BT.601."""
BT709, SMPTE170M = 1, 6
"""Numbers of ISO 23091-2 for colors; the second has the matrix of BT.601."""
CONSTANT_RATE_FACTOR = 10
"""Quality of x264: 0 is lossless, 51 the worst; from about 18 down no difference is seen."""


def write_video(
    path: Path,
    images: Iterable[NDArray[np.uint8]],
    frames_per_second: float,
    constant_rate_factor: int = CONSTANT_RATE_FACTOR,
) -> None:
    """Write an H.264 mp4, atomically. It says how its colors are stored, and can be played while it loads.

    Args:
        images: (H, W, 3) 8-bit RGB, one size; an odd last row or column is cropped, because the codec needs even sizes.
    Raises:
        CannotWrite: the disk rejects the file.
        ValueError: there are no images.
    """
    images = iter(images)
    if not (first := list(islice(images, 1))):
        raise ValueError("a video needs at least one image")
    height, width = first[0].shape[0] // 2 * 2, first[0].shape[1] // 2 * 2
    is_hd = len(first[0]) >= HD_ROWS
    matrix, tag = (Colorspace.ITU709, BT709) if is_hd else (Colorspace.ITU601, SMPTE170M)
    count = 0
    with whole_file(path) as temporary:
        # Without `file:`, what stands before a colon in a name would be taken for a protocol.
        with av.open(f"file:{temporary}", "w", options={"movflags": "+faststart"}) as container:
            rate = Fraction(frames_per_second).limit_denominator(1001)
            stream = container.add_stream("libx264", rate=rate, options={"crf": str(constant_rate_factor)})
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            context = stream.codec_context
            context.colorspace = context.color_primaries = context.color_trc = tag
            context.color_range = ColorRange.MPEG
            for image in chain(first, images):
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), format="rgb24")
                stored = frame.reformat(
                    format="yuv420p",
                    src_color_range=ColorRange.JPEG,
                    dst_color_range=ColorRange.MPEG,
                    dst_colorspace=matrix,
                )
                stored.pts, stored.time_base = count, 1 / rate
                container.mux(stream.encode(stored))
                count += 1
            container.mux(stream.encode())
        if num_frames(temporary) != count:  # an error while the file is closed is not reported
            raise BrokenPipeError(f"{path}: the encoder stopped before the end")


def num_frames(path: Path) -> int:
    """Number of frames of a video whose bytes are all there; 0 if the file is not a video."""
    try:
        with open_container(path) as video:
            return sum(packet.size > 0 and not packet.is_corrupt for packet in video.demux(video=0))
    except (FFmpegError, OSError, IndexError):
        return 0
