"""Which files are videos, and how FFmpeg opens them safely."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .reading import MOST_PIXELS

if TYPE_CHECKING:
    from av.container import InputContainer

VIDEO_SUFFIXES = {
    ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".vob", ".ts", ".mts", ".m2ts", ".mxf", ".wmv",
    ".ogv", ".flv", ".dv", ".h264", ".hevc", ".3gp", ".y4m", ".mjpeg", ".mjpg",
}  # fmt: skip
CONTAINERS = (
    "mov,mp4,matroska,webm,avi,mpegts,mpeg,mpegvideo,m4v,ogg,asf,flv,mxf,dv,h264,hevc,av1,obu,ivf,nut,gif,"
    "yuv4mpegpipe,mjpeg,apng,vvc,cine,h263,dnxhd"
)
"""FFmpeg formats that hold images themselves. Playlists are excluded: they name other files and addresses."""
STILL_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
"""Images that `prepare` reads from a folder."""
PLAYLISTS = (b"#EXTM3U", b"ffconcat", b"<MPD", b"<smil", b"[playlist]")
"""What stands in the first bytes of playlists."""
STILLS = (b"\x89PNG", b"\xff\xd8\xff", b"BM", b"II*\0", b"MM\0*", b"RIFF")
"""First bytes of image files; RIFF is WebP here, because FFmpeg reads AVI."""


def open_container(path: Path) -> InputContainer:
    """Open a video file with FFmpeg.

    Raises:
        av.error.FFmpegError, OSError, UnicodeError: it is no video that can be read.
    """
    import av

    # The scheme keeps FFmpeg from reading a colon in the name as an address; the lists restrict it to this file. FFmpeg
    # may decode an image to open a file, whatever size the container states.
    limits = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file", "max_pixels": str(MOST_PIXELS)}
    return av.open(f"file:{path.absolute()}", options=limits)


def is_video(path: Path) -> bool:
    """Whether an existing file has the suffix of a video, or FFmpeg finds images in it."""
    if path.suffix.lower() in VIDEO_SUFFIXES or is_animated_webp(path):
        return True
    import av

    try:
        with open_container(path) as container:
            return bool(container.streams.video)
    except (av.error.FFmpegError, OSError, UnicodeError):
        return False


def is_animated_webp(path: Path) -> bool:
    """Whether a file is a WebP animation, which FFmpeg does not read."""
    head = _head(path)
    return head[:4] == b"RIFF" and head[8:16] == b"WEBPVP8X" and bool(head[20] & 2)


def num_joined_mp4(path: Path) -> int:
    """How many MP4 or MOV files were written one after the other into this one; FFmpeg reads only the first."""
    count, at, size = 0, 0, path.stat().st_size
    with path.open("rb") as file:
        while at + 8 <= size:
            file.seek(at)
            head = file.read(16).ljust(16, b"\0")
            length = int.from_bytes(head[:4], "big")
            count += head[4:8] == b"ftyp"
            length = int.from_bytes(head[8:16], "big") if length == 1 else length
            if length < 8:  # up to the end of the file
                break
            at += length
    return count


def what_it_is(path: Path) -> str:
    """What a file is that FFmpeg takes for no video of `CONTAINERS`, in words; empty if unknown."""
    head = _head(path)
    if any(mark in head for mark in PLAYLISTS):
        return "a playlist, which only names other files"
    return "one image" if head.startswith(STILLS) else ""


def _head(path: Path) -> bytes:
    """The first bytes of a file, at least 32 of them; zeros for what is not there."""
    try:
        with path.open("rb") as file:
            return file.read(512).ljust(32, b"\0")
    except OSError:
        return bytes(32)
