"""Small video files for tests, lossless so that pixels can be compared."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
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
