"""The size of an encoded image from its header, so that an image that is too large is never decoded."""

from __future__ import annotations

import struct
import zlib

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of every PNG file."""
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
"""First and last bytes of every JPEG file; a few bytes of padding may follow."""
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Markers of the segment that holds the size."""
TIFF_WIDTH, TIFF_HEIGHT = 256, 257
TIFF_INTEGERS = {1: "B", 3: "H", 4: "I", 16: "Q"}
"""Types a size may have, as `struct` codes."""


def stored_size(encoded: bytes) -> tuple[int, int] | None:
    """(width, height), px, in the header of a PNG, JPEG, TIFF, BMP or WebP image.

    Returns:
        None if it is none of these, or the header is damaged.
    """
    for reader in (_png, _jpeg, _tiff, _bmp, _webp):
        try:
            if size := reader(encoded):
                return size
        except (struct.error, IndexError):  # truncated
            return None
    return None


def is_whole(encoded: bytes) -> bool:
    """Whether an image is complete: the checksums of a PNG match, a JPEG has its end. True for other kinds.

    Decoders check this as well, but print to stderr.
    """
    if encoded.startswith(PNG_SIGNATURE):
        return _png_is_whole(encoded)
    return not encoded.startswith(JPEG_START) or JPEG_END in encoded[-1024:]


def _png_is_whole(encoded: bytes) -> bool:
    at, data = len(PNG_SIGNATURE), memoryview(encoded)
    while at + 12 <= len(encoded):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 8 + length
        if end + 4 > len(encoded) or zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end + 4
    return False


def _png(encoded: bytes) -> tuple[int, int] | None:
    if not encoded.startswith(PNG_SIGNATURE) or encoded[12:16] != b"IHDR":
        return None
    return struct.unpack_from(">II", encoded, 16)


def _jpeg(encoded: bytes) -> tuple[int, int] | None:
    if not encoded.startswith(JPEG_START):
        return None
    at = 2
    while encoded[at] == 0xFF:
        marker = encoded[at + 1]
        if marker == 0xFF:  # padding
            at += 1
        elif marker in JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", encoded, at + 5)
            return width, height
        else:
            at += 2 + struct.unpack_from(">H", encoded, at + 2)[0]
    return None


def _tiff(encoded: bytes) -> tuple[int, int] | None:
    order = {b"II": "<", b"MM": ">"}.get(encoded[:2])
    if order is None:
        return None
    version = struct.unpack_from(f"{order}H", encoded, 2)[0]
    if version not in (42, 43):
        return None
    # 43 is BigTIFF: everything is twice as wide.
    offset, count, step = ("I", "H", 12) if version == 42 else ("Q", "Q", 20)
    at = struct.unpack_from(f"{order}{offset}", encoded, 4 if version == 42 else 8)[0]
    entries = struct.unpack_from(f"{order}{count}", encoded, at)[0]
    at += struct.calcsize(f"<{count}")
    size = {}
    for entry in range(at, min(at + entries * step, len(encoded)), step):
        tag, kind = struct.unpack_from(f"{order}HH", encoded, entry)
        if tag in (TIFF_WIDTH, TIFF_HEIGHT) and kind in TIFF_INTEGERS:
            size[tag] = struct.unpack_from(f"{order}{TIFF_INTEGERS[kind]}", encoded, entry + step // 2 + 2)[0]
    return (size[TIFF_WIDTH], size[TIFF_HEIGHT]) if len(size) == 2 else None


def _bmp(encoded: bytes) -> tuple[int, int] | None:
    if not encoded.startswith(b"BM"):
        return None
    width, height = struct.unpack_from("<ii", encoded, 18)
    return abs(width), abs(height)  # a negative height stands for rows from top to bottom


def _webp(encoded: bytes) -> tuple[int, int] | None:
    if encoded[:4] != b"RIFF" or encoded[8:12] != b"WEBP" or len(encoded) < 30:
        return None
    kind = encoded[12:16]
    if kind == b"VP8X":
        return tuple(1 + int.from_bytes(encoded[at : at + 3], "little") for at in (24, 27))
    if kind == b"VP8L":
        bits = int.from_bytes(encoded[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        return tuple(side & 0x3FFF for side in struct.unpack_from("<HH", encoded, 26))
    return None
