"""Which files are videos, and how FFmpeg opens them safely."""

from __future__ import annotations

import mmap
import re
from pathlib import Path
from typing import TYPE_CHECKING

from .reading import MAX_PIXELS

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
STILL_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")  # of images that `prepare` reads from a folder
PLAYLISTS = (b"#EXTM3U", b"ffconcat", b"<MPD", b"<smil", b"[playlist]")  # in the first bytes of playlists
HEADS = {
    "flv": rb"FLV\x01[\x01\x04\x05]\x00\x00\x00\x09",
    "asf": rb"\x30\x26\xb2\x75\x8e\x66\xcf\x11\xa6\xd9\x00\xaa\x00\x62\xce\x6c",
    "matroska": rb"\x1a\x45\xdf\xa3(?=.{0,60}(?:matroska|webm))",
}
"""What a file begins with, by a word of FFmpeg's name of the format."""
STILLS = (b"\x89PNG", b"\xff\xd8\xff", b"BM", b"II*\0", b"MM\0*", b"RIFF")
"""First bytes of image files; RIFF is WebP here, because FFmpeg reads AVI."""


def open_container(path: Path) -> InputContainer:
    """Open a video file with FFmpeg; av.error.FFmpegError, OSError or UnicodeError if it cannot be read."""
    import av

    # The scheme keeps FFmpeg from reading a colon in the name as an address; the lists restrict it to this file. FFmpeg
    # may decode an image to open a file, whatever size the container states.
    limits = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file", "max_pixels": str(MAX_PIXELS)}
    return av.open(f"file:{path.absolute()}", options=limits)


def is_video(path: Path) -> bool:
    """Whether an existing file has the suffix of a video, or FFmpeg finds images in it."""
    if path.suffix.lower() in VIDEO_SUFFIXES or is_animated_webp(path):
        return True
    from av.error import FFmpegError

    try:
        with open_container(path) as container:
            return bool(container.streams.video)
    except (FFmpegError, OSError, UnicodeError):
        return False


def is_animated_webp(path: Path) -> bool:
    """Whether a file is a WebP animation, which FFmpeg does not read."""
    head = _head(path)
    return head[:4] == b"RIFF" and head[8:16] == b"WEBPVP8X" and bool(head[20] & 2)


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


def starts_of_parts(path: Path, name: str) -> list[int]:
    """Where files begin, in bytes, that were written one after the other into this one, of a format of FFmpeg's name.

    FFmpeg may not read them all.
    """
    if "mp4" in name:
        return _starts_of_mp4(path)
    mark = next((mark for word, mark in HEADS.items() if word in name), None)
    if mark is None:
        return [0]
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return [found.start() for found in re.finditer(mark, content, re.DOTALL)]


def _starts_of_mp4(path: Path) -> list[int]:
    starts, at, size = [], 0, path.stat().st_size
    with path.open("rb") as file:
        while at + 8 <= size:
            file.seek(at)
            head = file.read(16).ljust(16, b"\0")
            length = int.from_bytes(head[:4], "big")
            starts += [at] if head[4:8] == b"ftyp" else []
            length = int.from_bytes(head[8:16], "big") if length == 1 else length
            if length < 8:  # up to the end of the file
                break
            at += length
    return starts
