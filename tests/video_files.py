"""Small video files for tests: lossless ones, so that pixels can be compared, and those of the ffmpeg program."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import imageio_ffmpeg
import numpy as np


def write_video(path: Path, pictures: Sequence[np.ndarray], rate: int = 25, times: Sequence[int] | None = None) -> Path:
    """(H, W, 3) pictures as FFV1 in Matroska (.mkv) or near-lossless H.264 (.mp4); `times` in 1/rate s, else even."""
    lossless = path.suffix == ".mkv"
    options = {} if lossless else {"movflags": "faststart"}
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("ffv1" if lossless else "libx264", rate=rate)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "bgr0" if lossless else "yuv444p"
        stream.codec_context.time_base = Fraction(1, rate)
        if not lossless:
            stream.options = {"crf": "8"}
        for index, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = (index if times is None else times[index]), Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def ffmpeg(*words: str | Path) -> Path:
    """Run the ffmpeg program of imageio; the last word is the file it writes, which is returned."""
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-loglevel", "error", "-y"]
    subprocess.run([*program, *map(str, words)], check=True)
    return Path(words[-1])


def moving_pattern(seconds: float) -> list[str]:
    """Input of ffmpeg: a moving pattern of 96x80 px at 25 frames per second."""
    return ["-f", "lavfi", "-i", f"testsrc2=size=96x80:rate=25:duration={seconds:g}"]
