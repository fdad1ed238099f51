"""Small images and videos that unfold to gigabytes, some of which state two sizes."""

from __future__ import annotations

import io
import struct
import zlib
from fractions import Fraction

import av
import cv2
import numpy as np

NOISE = np.random.default_rng(0).integers(0, 255, (40, 48, 3), dtype=np.uint8)
FRAME_MARKER = b"\xff\xc2\0\x0b\x08"
"""Start of the segment of a gray progressive JPEG that holds height and width."""


def jpeg_bomb(width: int = 65500, height: int = 65500) -> bytes:
    """A tiny progressive JPEG of this size."""
    sound = cv2.imencode(".jpg", NOISE[..., 0], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    at = sound.index(FRAME_MARKER) + len(FRAME_MARKER)
    return sound[:at] + struct.pack(">HH", height, width) + sound[at + 4 :]


def jpeg_of_two_sizes() -> bytes:
    """A JPEG of 16000x16000 px that says 16x16 to readers for which every marker has a length.

    The marker 01 has none. Who reads one jumps over the next segment, into a comment that holds another start.
    """
    bomb, first = jpeg_bomb(16000, 16000), 60000
    comment = b"\xff\xfe" + struct.pack(">H", first) + bytes(first - 2)
    gap = 4 + 0xFFFE - (2 + 2 + len(comment))
    start = b"\xff\xc0\0\x0b\x08\0\x10\0\x10\1\1\x11\0\xff\xd9"
    other = bytes(gap - 4) + start + bytes(100)
    return bomb[:2] + b"\xff\x01" + comment + b"\xff\xfe" + struct.pack(">H", len(other) + 2) + other + bomb[2:]


def tiff_bomb(*sizes: tuple[int, int]) -> bytes:
    """A gray TIFF that states each of these sizes; its strips of 100 rows are the same few bytes."""
    width, height = max(sizes)
    strip, count = zlib.compress(bytes(100 * width), 9), height // 100
    tags = [(tag, 4, 1, struct.pack("<I", side)) for size in sizes for tag, side in zip((256, 257), size, strict=True)]
    tags += [(tag, 3, 1, struct.pack("<HH", value, 0)) for tag, value in ((258, 8), (259, 8), (262, 1), (277, 1))]
    tags += [(278, 4, 1, struct.pack("<I", 100))]
    at = 8 + 2 + 12 * (len(tags) + 2) + 4
    body = strip
    for tag, value in ((273, at), (279, len(strip))):
        tags.append((tag, 4, count, struct.pack("<I", at + len(body))))
        body += struct.pack("<I", value) * count
    directory = b"".join(struct.pack("<HHI", *tag[:3]) + tag[3] for tag in sorted(tags, key=lambda tag: tag[0]))
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + directory + bytes(4) + body


def mov_bomb(picture: bytes, codec: str = "png") -> bytes:
    """A QuickTime video of 64x48 px whose images are this larger one. FFmpeg decodes one when it opens the file."""
    written = io.BytesIO()
    with av.open(written, "w", format="mov") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "rgb24" if codec == "png" else "yuvj420p"
        stream.codec_context.time_base = Fraction(1, 25)
        for index in range(3):
            packet = av.Packet(picture)
            packet.stream, packet.pts, packet.dts, packet.is_keyframe = stream, index, index, True
            packet.time_base = Fraction(1, 25)
            container.mux(packet)
    return written.getvalue()
