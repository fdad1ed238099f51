"""Image files to arrays; error messages name the file, what is expected and what it holds.

Pillow reads the header first, so that an image that is too large is never decoded; OpenCV decodes.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ExifTags import Base as Tag
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from PIL.WebPImagePlugin import WebPImageFile

from ..core.checks import input_error
from .pixels import is_measured
from .reading import MOST_PIXELS, read_bytes

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


PNG_END = b"IEND\xaeB`\x82"
"""Last bytes of every PNG file."""


def read_color(path: Path, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Read an 8-bit color image.

    Args:
        path: the file; an alpha channel is dropped.
        size: (width, height) it must have, px; None accepts any.
    Returns:
        (H, W, 3) red, green, blue, 0..255.
    Raises:
        InputError: unreadable, not 8-bit color, or of another size.
    """
    pixels = decode_image(path, size)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise input_error(path, "an 8-bit RGB image", describe_pixels(pixels), "convert it to 8-bit RGB.")
    return np.ascontiguousarray(pixels[..., 2::-1])


def read_tool_mask(path: Path, tool_value: int = 255, size: tuple[int, int] | None = None) -> NDArray[np.bool_]:
    """Read a binary mask file.

    Args:
        path: an 8-bit image with values 0 and 255 only, gray or with equal channels.
        tool_value: 255, or 0 where the file marks tissue instead of tools.
        size: (width, height) it must have, px; None accepts any.
    Returns:
        (H, W) True on tools.
    Raises:
        InputError: unreadable, of another size or depth, or with other values.
    """
    pixels = single_channel(path, decode_image(path, size))
    if pixels.dtype != np.uint8:
        raise input_error(path, "an 8-bit mask", describe_pixels(pixels), "save it with values 0 and 255.")
    high = pixels == 255
    other = pixels[~high & (pixels != 0)]
    if other.size:
        values = np.unique(other)
        zero_and_one = values.tolist() == [1] and not high.any()
        hint = "multiply it by 255." if zero_and_one else "threshold it, without smoothing."
        raise input_error(path, "mask values 0 and 255", _list_some(values), hint)
    return high if tool_value == 255 else ~high


def read_depth(path: Path, scale: float = 1.0, size: tuple[int, int] | None = None) -> NDArray[np.float32]:
    """Read a depth image.

    Args:
        path: an 8-bit or 16-bit image, gray or with equal channels.
        scale: mm per unit of the file.
        size: (width, height) it must have, px; None accepts any.
    Returns:
        (H, W) depth, mm; 0 where the file has 0, and with 16 bits what else stands for missing (`is_measured`).
    Raises:
        InputError: unreadable, of another size or depth.
    """
    pixels = single_channel(path, decode_image(path, size))
    if pixels.dtype not in (np.uint8, np.uint16):
        raise input_error(path, "an 8-bit or 16-bit depth image", describe_pixels(pixels), "save it as 16-bit PNG.")
    depth = pixels.astype(np.float32) * np.float32(scale)
    return depth if pixels.dtype == np.uint8 else np.where(is_measured(pixels), depth, np.float32(0))


def decode_image(path: Path, size: tuple[int, int] | None, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray:
    """Decode a PNG, JPEG, TIFF, BMP or WebP file.

    Args:
        path: the file.
        size: (width, height) it must have, px; None accepts any.
        flags: of `cv2.imdecode`: as stored, or converted.
    Returns:
        The array, (H, W) or (H, W, C) with channels in OpenCV's order (blue first), upright: turned as EXIF says.
    Raises:
        InputError: unreadable, of another format, truncated, of more than `MOST_PIXELS`, or of another size.
    """
    encoded = read_bytes(path)
    data = encoded.tobytes()
    header = read_header(data)
    if header and header.width * header.height > MOST_PIXELS:
        got = f"{header.width}x{header.height} px in its header"
        raise input_error(path, f"an image of at most {MOST_PIXELS // 1_000_000} Mpx", got, "scale it down.")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error below replaces its messages
    try:
        pixels = cv2.imdecode(encoded, flags | cv2.IMREAD_IGNORE_ORIENTATION) if header else None
    except cv2.error:
        pixels = None
    if pixels is None:
        got = f"{encoded.size} bytes that cannot be decoded"
        raise input_error(path, "an image (PNG, JPEG, TIFF, BMP, WebP)", got, "write the file again.")
    if not data.startswith(TIFF_STARTS):  # OpenCV turns TIFF whatever it is told
        pixels = _upright(pixels, header.orientation)
    got = (pixels.shape[1], pixels.shape[0])
    if size is not None and got != size:
        want, fix = f"{size[0]}x{size[1]} px like the first image", "bring all images, masks and depth to one size."
        raise input_error(path, want, f"{got[0]}x{got[1]}", fix)
    return pixels


def _upright(pixels: NDArray, orientation: int) -> NDArray:
    """Stored pixels as they are shown. Args: orientation: 1 to 8, as EXIF counts them."""
    if orientation in TURNED:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def save_png(path: Path, pixels: NDArray, compression: int = 1) -> None:
    """Write a PNG. It is encoded in memory first, because libpng prints to stderr when the disk is full.

    Args:
        pixels, compression: as `encode_png`.
    Raises:
        OSError: the disk is full or not writable.
        MemoryError: as `encode_png`.
    """
    path.write_bytes(encode_png(pixels, compression))


def encode_png(pixels: NDArray, compression: int = 1) -> bytes:
    """The bytes of a PNG file.

    Args:
        pixels: (H, W) 8- or 16-bit, or (H, W, 3) 8-bit red, green, blue.
        compression: 0 to 9.
    Raises:
        MemoryError: the encoder stopped; libpng has no other reason with pixels of these types.
    """
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error below replaces its messages
    stored = np.ascontiguousarray(pixels[..., ::-1]) if pixels.ndim == 3 else pixels
    done, encoded = cv2.imencode(".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, compression])
    if not done or not (data := encoded.tobytes()).endswith(PNG_END):
        raise MemoryError("a PNG encoder that stopped")
    return data


def single_channel(path: Path, pixels: NDArray) -> NDArray:
    """(H, W) view of a gray image, or of one stored with equal color channels."""
    if pixels.ndim == 2:
        return pixels
    first = pixels[..., 0]
    if any((pixels[..., c] != first).any() for c in range(1, min(pixels.shape[2], 3))):
        raise input_error(path, "one channel", "a color image", "save the values themselves, not a color map.")
    return first


def describe_pixels(pixels: NDArray) -> str:
    """Type and channels of an array as text, such as '16-bit, 1 channel'."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    kind = "float" if np.issubdtype(pixels.dtype, np.floating) else f"{8 * pixels.dtype.itemsize}-bit"
    return f"{kind}, {channels} channel{'s' if channels > 1 else ''}"


def _list_some(values: NDArray) -> str:
    """At most four of the values, comma separated."""
    return ", ".join(str(v) for v in values[:4].tolist()) + (" and more" if len(values) > 4 else "")
