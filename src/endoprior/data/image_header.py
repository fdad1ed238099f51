"""What the header of an encoded image says, read by Pillow, so that an image that is too large is never decoded."""

from __future__ import annotations

import io
import warnings
from typing import NamedTuple

from PIL.BmpImagePlugin import BmpImageFile
from PIL.ExifTags import Base as Tag
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from PIL.WebPImagePlugin import WebPImageFile

READERS = {b"\x89PNG": PngImageFile, b"\xff\xd8": JpegImageFile, b"BM": BmpImageFile, b"RIFF": WebPImageFile}
"""Pillow's readers, by the first bytes of a file. `PIL.Image.open` has a limit of its own, for the whole process."""
TIFF_STARTS = (b"II", b"MM")
"""First bytes of TIFF files: the order of bytes in a number. Pillow's own reader knows fewer kinds of pixels."""
BIG_TIFF = 43
JPEG_END = b"\xff\xd9"
TURNED = range(5, 9)
"""Orientations that exchange width and height."""
warnings.filterwarnings("ignore", module=r"PIL\.\w+Plugin")  # of damaged tags, which are read as missing


class ImageHeader(NamedTuple):
    """An image before it is decoded."""

    width: int
    """Of the image as it is shown, px."""
    height: int
    orientation: int
    """How the stored pixels lie, by EXIF: 1 as they are shown, 2 to 8 mirrored or turned; 1 if nothing is said."""


def read_header(encoded: bytes) -> ImageHeader | None:
    """The header of a PNG, JPEG, TIFF, BMP or WebP image.

    Returns:
        None if it is none of these, or damaged. Decoders check the pixels of most kinds, but print to stderr for a PNG
        with a wrong checksum and a JPEG without its end. What phones and editors add after the end does not count.
    """
    try:
        if encoded.startswith(TIFF_STARTS):
            tags = ImageFileDirectory_v2(encoded[: 16 if encoded[2] == BIG_TIFF else 8])
            file = io.BytesIO(encoded)
            file.seek(tags.next)
            tags.load(file)
            (width, height), orientation = (tags[Tag.ImageWidth], tags[Tag.ImageLength]), tags.get(Tag.Orientation)
        else:
            (width, height), orientation = _read_by_pillow(encoded)
    except Exception:  # Pillow raises many kinds for damaged files
        return None
    if not (isinstance(width, int) and isinstance(height, int)):
        return None
    orientation = orientation if orientation in range(1, 9) else 1
    return ImageHeader(*((height, width) if orientation in TURNED else (width, height)), orientation)


def _read_by_pillow(encoded: bytes) -> tuple[tuple[int, int], int | None]:
    """Stored size, px, and orientation; raises what Pillow raises if the file is damaged."""
    file = io.BytesIO(encoded)
    image = next(reader for start, reader in READERS.items() if encoded.startswith(start))(file)
    if isinstance(image, JpegImageFile):
        encoded.index(JPEG_END, file.tell())  # Pillow stops at the compressed pixels, which hold no such bytes
    if isinstance(image, PngImageFile):
        if "exif" not in image.info:  # behind the pixels, where Pillow finds it only after decoding them
            image.info["exif"] = encoded.partition(b"eXIf")[2]
        image.verify()
    try:
        return image.size, image.getexif().get(Tag.Orientation)
    except Exception:  # damaged EXIF says nothing
        return image.size, None
