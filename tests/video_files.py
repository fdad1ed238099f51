"""Small video files for tests: lossless ones, so that pixels can be compared, and those of the ffmpeg program."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
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


def smooth(count, height=64, width=96, seed=0, step=2):
    """(H, W, 3) images of a texture that moves by `step` px a frame."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.random((height, width + step * count, 3)).astype(np.float32), (0, 0), 1.5)
    noise = (255 * (noise - noise.min()) / np.ptp(noise)).astype(np.uint8)
    return [np.ascontiguousarray(noise[:, step * i : step * i + width]) for i in range(count)]


def encode(path, images, codec="libx264", pixels="yuv420p", options=None, times=None, rate=25, **context):
    """Write a video; `times` in 1/rate s."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.options = pixels, options or ({"crf": "10"} if codec == "libx264" else {})
        for name, value in context.items():
            setattr(stream.codec_context, name, value)
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = (index if times is None else times[index]), Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def psnr(a, b):
    return 10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-3))
