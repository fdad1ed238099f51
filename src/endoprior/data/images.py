"""Image and depth files to arrays; error messages name the file, what is expected and what it holds.

Pillow reads the header of an image first, so that one that is too large is never decoded; OpenCV decodes. Depth and
disparity may also be NumPy or EXR files. `size` is the (width, height) that a file must have, px; None accepts any. All
readers raise InputError for a file that is unreadable, of another kind or of another size.
"""

from __future__ import annotations

import io
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
from ..core.shell import install_command
from ..system.atomic import whole_file
from .pixels import is_measured
from .reading import MAX_PIXELS, demand_file, read_bytes, read_only_array

READERS = {b"\x89PNG": PngImageFile, b"\xff\xd8": JpegImageFile, b"BM": BmpImageFile, b"RIFF": WebPImageFile}
"""Pillow's readers, by the first bytes of a file. `PIL.Image.open` has a limit of its own, for the whole process."""
TIFF_STARTS = (b"II", b"MM")  # the order of bytes in a number. Pillow's own reader knows fewer kinds of pixels
BIG_TIFF = 43
JPEG_END, PNG_END = b"\xff\xd9", b"IEND\xaeB`\x82"
TURNED = range(5, 9)  # orientations, as EXIF counts them, that exchange width and height
MIRRORED = (2, 4, 5, 7)
SILENT = 0  # OpenCV: LOG_LEVEL_SILENT
DEPTH_SUFFIXES = (".png", ".npy", ".npz", ".tiff", ".tif", ".exr")
TOOL_VALUE = 255  # of tool pixels in mask files that this program writes; tissue is 0
Size = tuple[int, int]


class ImageHeader(NamedTuple):
    """An image before it is decoded."""

    width: int  # of the image as it is shown, px
    height: int
    orientation: int  # of the stored pixels, by EXIF: 1 as they are shown, or not said; 2 to 8 mirrored or turned


def read_header(encoded: bytes) -> ImageHeader | None:
    """The header of a PNG, JPEG, TIFF, BMP or WebP image; None if it is none of these, or damaged.

    Decoders check the pixels of most kinds, but print to stderr for a PNG with a wrong checksum and a JPEG without its
    end. What phones and editors add after the end does not count.
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
    if not isinstance(orientation, int) or orientation not in range(2, 9):
        return ImageHeader(width, height, 1)
    return ImageHeader(*((height, width) if orientation in TURNED else (width, height)), orientation)


def _read_by_pillow(encoded: bytes) -> tuple[Size, int | None]:
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


def _silence_opencv() -> None:
    """OpenCV writes nothing to stderr; the function has one name in OpenCV 4 and another in OpenCV 5."""
    set_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    set_level(SILENT)


def decode_image(path: Path, size: Size | None, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray:
    """Decode a PNG, JPEG, TIFF, BMP or WebP file; `flags` of `cv2.imdecode`: as stored, or converted.

    Returns:
        The array, (H, W) or (H, W, C) with channels in OpenCV's order (blue first), upright: turned as EXIF says.
    """
    encoded = read_bytes(path)
    data = encoded.tobytes()
    header = read_header(data)
    if header and header.width * header.height > MAX_PIXELS:
        got = f"{header.width}x{header.height} px in its header"
        raise input_error(path, f"an image of at most {MAX_PIXELS // 1_000_000} Mpx", got, "scale it down.")
    _silence_opencv()  # the error below replaces its messages
    try:
        pixels = cv2.imdecode(encoded, flags | cv2.IMREAD_IGNORE_ORIENTATION) if header else None
    except cv2.error:
        pixels = None
    if pixels is None or header is None:
        got = f"{encoded.size} bytes that cannot be decoded"
        raise input_error(path, "an image (PNG, JPEG, TIFF, BMP, WebP)", got, "write the file again.")
    if not data.startswith(TIFF_STARTS):  # OpenCV turns TIFF whatever it is told
        pixels = upright(pixels, header.orientation)
    _demand_size(path, pixels, size)
    return pixels


def upright(pixels: NDArray, orientation: int) -> NDArray:
    """Stored pixels (H, W, ...) as they are shown, by their EXIF orientation, 1 to 8."""
    if orientation in TURNED:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _demand_size(path: Path, pixels: NDArray, size: Size | None) -> None:
    got = (pixels.shape[1], pixels.shape[0])
    if size is not None and got != size:
        want, fix = f"{size[0]}x{size[1]} px like the first image", "bring all images, masks and depth to one size."
        raise input_error(path, want, f"{got[0]}x{got[1]}", fix)


def read_color(path: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """(H, W, 3) red, green, blue, 0..255, of an 8-bit color image; an alpha channel is dropped."""
    pixels = decode_image(path, size)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise input_error(path, "an 8-bit RGB image", describe_pixels(pixels), "convert it to 8-bit RGB.")
    return np.ascontiguousarray(pixels[..., 2::-1])


def read_tool_mask(path: Path, tool_value: int = TOOL_VALUE, size: Size | None = None) -> NDArray[np.bool_]:
    """(H, W) True on tools, of an 8-bit image with values 0 and 255 only, one of which is that of tools."""
    pixels = single_channel(path, decode_image(path, size))
    if pixels.dtype != np.uint8:
        raise input_error(path, "an 8-bit mask", describe_pixels(pixels), "save it with values 0 and 255.")
    high = pixels == 255
    if other := np.unique(pixels[~high & (pixels != 0)]).tolist():
        zero_and_one = other == [1] and not high.any()
        hint = "multiply it by 255." if zero_and_one else "threshold it, without smoothing."
        got = ", ".join(map(str, other[:4])) + (" and more" if len(other) > 4 else "")
        raise input_error(path, "mask values 0 and 255", got, hint)
    return high if tool_value == 255 else ~high


def tool_mask_pixels(tool_mask: NDArray[np.bool_], tool_value: int = TOOL_VALUE) -> NDArray[np.uint8]:
    """(H, W) stored values of a mask, (H, W) True on tools; `tool_value` is that of tools in the file, 255 or 0."""
    return np.where(tool_mask if tool_value == 255 else ~tool_mask, 255, 0).astype(np.uint8)


def write_tool_mask(file: Path, tool_mask: NDArray[np.bool_], tool_value: int = TOOL_VALUE) -> None:
    """Write one mask, atomically; arguments as in `tool_mask_pixels`."""
    with whole_file(file) as temporary:
        save_png(temporary, tool_mask_pixels(tool_mask, tool_value))


def read_share(path: Path, size: Size | None = None) -> NDArray[np.float32]:
    """(H, W) in [0, 1] of an 8-bit gray image, whose 255 stands for 1."""
    pixels = single_channel(path, decode_image(path, size))
    if pixels.dtype != np.uint8:
        raise input_error(path, "an 8-bit gray image", describe_pixels(pixels), "save it with values 0 to 255.")
    return pixels.astype(np.float32) / np.float32(255)


def read_depth(path: Path, scale: float = 1.0, size: Size | None = None) -> NDArray[np.float32]:
    """(H, W) depth, mm, of an 8-bit or 16-bit image, gray or with equal channels; `scale` is mm per unit of the file.

    It is 0 where the file has 0, or what else stands for missing (`is_measured`).
    """
    pixels = single_channel(path, decode_image(path, size))
    if pixels.dtype not in (np.uint8, np.uint16):
        raise input_error(path, "an 8-bit or 16-bit depth image", describe_pixels(pixels), "save it as 16-bit PNG.")
    return np.where(is_measured(pixels), pixels.astype(np.float32) * np.float32(scale), np.float32(0))


def read_depth_file(
    path: Path, mm_per_unit: float = 1.0, size: Size | None = None, *, relative: bool = False
) -> NDArray[np.float32]:
    """(H, W) depth, mm, of a file of `read_stored`; 0 where it is missing (`is_measured`, which takes `relative`)."""
    stored = read_stored(path, size)
    depth = _as_float32(stored) * np.float32(mm_per_unit)
    return np.where(is_measured(stored, relative=relative) & np.isfinite(depth), depth, np.float32(0))


def read_values(path: Path, size: Size | None = None) -> NDArray[np.float32]:
    """(H, W) numbers of a file as `read_stored` reads, none of them missing."""
    return _as_float32(read_stored(path, size))


def read_stored(path: Path, size: Size | None = None) -> NDArray:
    """(H, W) numbers of a one-channel file in their own type.

    PNG or TIFF (8 or 16 bit, TIFF also float), NPY, NPZ with one array, or EXR, which needs the OpenEXR package.
    """
    suffix = path.suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise input_error(path, f"one of {', '.join(DEPTH_SUFFIXES)}", suffix or "no suffix", "convert the file.")
    if suffix in (".npy", ".npz"):
        pixels = _read_numpy(path)
    elif suffix == ".exr":
        pixels = _read_exr(path)
    else:
        pixels = single_channel(path, decode_image(path, size))
    if pixels.dtype.kind not in "iuf":
        raise input_error(path, "integers or floats", str(pixels.dtype), "save it as float or 16-bit.")
    _demand_size(path, pixels, size)
    return pixels


def _as_float32(stored: NDArray) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # a float64 beyond float32 becomes infinity, which is missing
        return stored.astype(np.float32)


def _read_numpy(path: Path) -> NDArray:
    """The (H, W) array; axes of length 1 in front of the others or behind them are dropped."""
    hint = "write it again with numpy.save."
    array = read_only_array(path, hint)
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2:
        raise input_error(path, "an array of shape (H, W)", f"shape {array.shape}", hint)
    return array


def _read_exr(path: Path) -> NDArray:
    """The (H, W) channel of an EXR file: its only one, `Z`, or several that are equal."""
    try:
        import OpenEXR  # optional: the packages of OpenCV have no EXR decoder
    except ImportError:
        raise input_error(path, "the OpenEXR package", "none", f"`{install_command('exr')}`.") from None
    demand_file(path, "an EXR image", "write the file again.")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            (left, top), (right, bottom) = (np.asarray(corner, int).tolist() for corner in file.header()["dataWindow"])
        if (right - left + 1) * (bottom - top + 1) > MAX_PIXELS:
            raise ValueError(f"{right - left + 1}x{bottom - top + 1} px by its header")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # the library raises many kinds, RuntimeError among them
        raise input_error(path, "an EXR image", str(error).split("\n")[0], "write the file again.") from None
    if "Z" in channels:
        return channels["Z"]
    planes = [channels[name] for name in channels if name != "A"]
    if not planes or not all(np.array_equal(planes[0], other, equal_nan=True) for other in planes[1:]):
        hint = "save depth alone, as channel Z."
        raise input_error(path, "one channel, or one called Z", ", ".join(channels) or "none", hint)
    return planes[0]


def single_channel(path: Path, pixels: NDArray) -> NDArray:
    """(H, W) view of a gray image, or of one stored with equal color channels."""
    if pixels.ndim == 2:
        return pixels
    if (pixels[..., 1:3] != pixels[..., :1]).any():
        raise input_error(path, "one channel", "a color image", "save the values themselves, not a color map.")
    return pixels[..., 0]


def describe_pixels(pixels: NDArray) -> str:
    """Type and channels of an array as text, such as '16-bit, 1 channel'."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    kind = "float" if np.issubdtype(pixels.dtype, np.floating) else f"{8 * pixels.dtype.itemsize}-bit"
    return f"{kind}, {channels} channel{'s' if channels > 1 else ''}"


def save_png(path: Path, pixels: NDArray, compression: int = 1) -> None:
    """Write a PNG, encoded in memory first (`encode_png`): libpng prints to stderr when the disk is full."""
    path.write_bytes(encode_png(pixels, compression))


def encode_png(pixels: NDArray, compression: int = 1) -> bytes:
    """The bytes of a PNG file of (H, W) 8- or 16-bit pixels, or (H, W, 3) 8-bit red, green, blue.

    MemoryError if the encoder stopped: libpng has no other reason with pixels of these types.
    """
    _silence_opencv()  # the error below replaces its messages
    stored = np.ascontiguousarray(pixels[..., ::-1]) if pixels.ndim == 3 else pixels
    done, encoded = cv2.imencode(".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, compression])
    if not done or not (data := encoded.tobytes()).endswith(PNG_END):
        raise MemoryError("a PNG encoder that stopped")
    return data
