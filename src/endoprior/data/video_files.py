"""Which files are videos, and how FFmpeg opens them safely."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from av.container import InputContainer

VIDEO_SUFFIXES = {
    ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".mxf", ".wmv", ".ogv",
    ".flv", ".dv", ".h264", ".hevc",
}  # fmt: skip
CONTAINERS = "mov,mp4,matroska,webm,avi,mpegts,mpeg,mpegvideo,m4v,ogg,asf,flv,mxf,dv,h264,hevc,av1,obu,ivf,nut,gif"
"""FFmpeg formats that hold images themselves. Playlists are excluded: they name other files and addresses."""
STILL_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
"""Images that `prepare` reads from a folder."""


def open_container(path: Path) -> InputContainer:
    """Open a video file with FFmpeg.

    Raises:
        av.error.FFmpegError, OSError, UnicodeError: it is no video that can be read.
    """
    import av

    # The scheme keeps FFmpeg from reading a colon in the name as an address; the lists restrict it to this file.
    limits = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
    return av.open(f"file:{path.absolute()}", options=limits)


def is_video(path: Path) -> bool:
    """Whether an existing file has the suffix of a video, or FFmpeg finds images in it."""
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return True
    import av

    try:
        with open_container(path) as container:
            return bool(container.streams.video)
    except (av.error.FFmpegError, OSError, UnicodeError):
        return False
