"""The size of an encoded image from its header, so that an image that is too large is never decoded.

The orientation that cameras store in it (EXIF), and whether it is complete, stand here as well.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of every PNG file."""
JPEG_START = b"\xff\xd8"
"""First bytes of every JPEG file."""
JPEG_END, JPEG_SCAN, JPEG_APP1 = 0xD9, 0xDA, 0xE1
"""Markers of the end, of compressed pixels, and of the segment that may hold EXIF."""
NEXT_MARKER = re.compile(rb"\xff+([^\x00\xd0-\xd7\xff])")
"""A marker among compressed pixels, in which a zero or the number of a restart follows each 0xFF."""
EXIF = b"Exif\0\0"
TURNED = range(5, 9)
"""Orientations that exchange width and height."""
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Markers of the segment that holds the size."""
TIFF_STARTS = (b"II", b"MM")
"""First bytes of TIFF files: the order of bytes in a number."""
TIFF_WIDTH, TIFF_HEIGHT, TIFF_ORIENTATION = 256, 257, 274
TIFF_INTEGERS = {1: "B", 3: "H", 4: "I", 16: "Q"}
"""Types a size may have, as `struct` codes."""


def stored_size(encoded: bytes) -> tuple[int, int] | None:
    """(width, height), px, of a PNG, JPEG, TIFF, BMP or WebP image as it is shown, from its header.

    Returns:
        None if it is none of these, or the header is damaged.
    """
    for reader in (_png, _jpeg, _tiff, _bmp, _webp):
        try:
            if size := reader(encoded):
                return size[::-1] if orientation(encoded) in TURNED else size
        except (struct.error, IndexError):  # truncated
            return None
    return None


def orientation(encoded: bytes) -> int:
    """How the stored pixels lie, by EXIF: 1 as they are shown, 2 to 8 mirrored or turned; 1 if nothing is said."""
    try:
        found = _tiff_numbers(_exif(encoded)).get(TIFF_ORIENTATION, 1)
    except (struct.error, IndexError):
        return 1
    return found if 1 <= found <= 8 else 1


def is_whole(encoded: bytes) -> bool:
    """Whether an image is complete: the checksums of a PNG match, a JPEG has its end. True for other kinds.

    Decoders check this as well, but print to stderr. What phones and editors add after the end does not count.
    """
    if encoded.startswith(PNG_SIGNATURE):
        return _png_is_whole(encoded)
    return not encoded.startswith(JPEG_START) or any(marker == JPEG_END for marker, _ in _jpeg_segments(encoded))


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
    at = next((at for marker, at in _jpeg_segments(encoded) if marker in JPEG_FRAMES), None)
    if at is None:
        return None
    height, width = struct.unpack_from(">HH", encoded, at + 3)
    return width, height


def _jpeg_segments(encoded: bytes) -> Iterator[tuple[int, int]]:
    """Marker, and position of what follows it, of each segment up to the end or to where the file is damaged."""
    found = NEXT_MARKER.match(encoded, 2) if encoded.startswith(JPEG_START) else None
    while found:
        marker, at = found[1][0], found.end()
        yield marker, at
        if marker == JPEG_END or at + 2 > len(encoded):
            return
        behind = at + struct.unpack_from(">H", encoded, at)[0]
        # Compressed pixels have no length.
        found = (NEXT_MARKER.search if marker == JPEG_SCAN else NEXT_MARKER.match)(encoded, behind)


def _exif(encoded: bytes) -> bytes:
    """What an image says in EXIF, which is a TIFF without pixels; a TIFF itself; empty if there is none."""
    if encoded.startswith(JPEG_START):
        found = (at + 2 for marker, at in _jpeg_segments(encoded) if marker == JPEG_APP1)
        return next((encoded[at + len(EXIF) :] for at in found if encoded[at : at + len(EXIF)] == EXIF), b"")
    if encoded.startswith(PNG_SIGNATURE):
        at = len(PNG_SIGNATURE)
        while at + 8 <= len(encoded):
            if encoded[at + 4 : at + 8] == b"eXIf":
                return encoded[at + 8 :]
            at += 12 + struct.unpack_from(">I", encoded, at)[0]
        return b""
    if encoded[:4] == b"RIFF" and encoded[8:12] == b"WEBP":
        at = 12
        while at + 8 <= len(encoded):
            length = struct.unpack_from("<I", encoded, at + 4)[0]
            if encoded[at : at + 4] == b"EXIF":
                return encoded[at + 8 :].removeprefix(EXIF)
            at += 8 + length + length % 2
        return b""
    return encoded


def _tiff(encoded: bytes) -> tuple[int, int] | None:
    found = _tiff_numbers(encoded)
    return (found[TIFF_WIDTH], found[TIFF_HEIGHT]) if {TIFF_WIDTH, TIFF_HEIGHT} <= found.keys() else None


def _tiff_numbers(encoded: bytes) -> dict[int, int]:
    """The integers of the first directory of a TIFF, by tag; empty for something else."""
    order = dict(zip(TIFF_STARTS, "<>", strict=True)).get(encoded[:2])
    if order is None:
        return {}
    version = struct.unpack_from(f"{order}H", encoded, 2)[0]
    if version not in (42, 43):
        return {}
    # 43 is BigTIFF: everything is twice as wide.
    offset, count, step = ("I", "H", 12) if version == 42 else ("Q", "Q", 20)
    at = struct.unpack_from(f"{order}{offset}", encoded, 4 if version == 42 else 8)[0]
    entries = struct.unpack_from(f"{order}{count}", encoded, at)[0]
    at += struct.calcsize(f"<{count}")
    numbers = {}
    for entry in range(at, min(at + entries * step, len(encoded)), step):
        tag, kind = struct.unpack_from(f"{order}HH", encoded, entry)
        if kind in TIFF_INTEGERS:
            numbers[tag] = struct.unpack_from(f"{order}{TIFF_INTEGERS[kind]}", encoded, entry + step // 2 + 2)[0]
    return numbers


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
