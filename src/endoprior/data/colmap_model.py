"""COLMAP's sparse model, `cameras` and `images` as text or binary: lenses, and the pose of each registered image.

The format is described at https://colmap.github.io/format.html. Binary numbers are little endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..core.checks import InputError, input_error
from .lens import MODELS, Lens
from .reading import read_bytes, read_text

FIX = "export the model again."
MOST_IMAGES = 1_000_000


@dataclass(frozen=True)
class StoredCamera:
    """One camera as the file has it."""

    model: str
    """One of `MODELS`, or another word."""
    width: int
    height: int
    values: list[float]


@dataclass(frozen=True)
class RegisteredImage:
    """One image of a model."""

    name: str
    """Its file, below the folder of images."""
    lens: Lens
    world_to_camera: NDArray[np.float64]
    """(4, 4), OpenCV axes, in units of the model."""


def read_colmap(folder: Path) -> tuple[list[RegisteredImage], list[Path]]:
    """The registered images of a model, in the order of its file, and the files that were read.

    Raises:
        InputError: a file is missing or damaged, or a lens has a model that is not supported.
    """
    suffix = ".bin" if (folder / "images.bin").exists() else ".txt"
    cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
    lenses = {number: _lens(cameras, each) for number, each in read_cameras(cameras).items()}
    try:
        rows = _images_of_bytes(images) if suffix == ".bin" else _images_of_text(images)
    except (struct.error, IndexError, UnicodeDecodeError):
        raise _cut(images) from None
    if not rows:
        raise input_error(images, "registered images", "none", FIX)
    found = []
    for name, camera, pose in rows:
        if camera not in lenses:
            raise input_error(images, f"cameras of {cameras.name}", f"camera {camera}", FIX)
        if not (np.isfinite(pose).all() and np.linalg.norm(pose[:4]) > 0):
            raise input_error(images, "finite poses", f"others for {name}", FIX)
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(pose[[1, 2, 3, 0]]).as_matrix()
        matrix[:3, 3] = pose[4:]
        found.append(RegisteredImage(name, lenses[camera], matrix))
    return found, [cameras, images]


def read_cameras(path: Path) -> dict[int, StoredCamera]:
    """The cameras of `cameras.txt` or `cameras.bin` by their numbers.

    Raises:
        InputError: the file is damaged.
    """
    try:
        return _cameras_of_bytes(path) if path.suffix == ".bin" else _cameras_of_text(path)
    except (struct.error, IndexError, UnicodeDecodeError):
        raise _cut(path) from None


def _cut(path: Path) -> InputError:
    return input_error(path, "a model of COLMAP", f"a {path.suffix} file that ends too early", FIX)


def _lens(path: Path, camera: StoredCamera) -> Lens:
    names = MODELS.get(camera.model, "").split()
    if names and len(names) != len(camera.values):
        raise input_error(path, f"{len(names)} parameters of {camera.model}", f"{len(camera.values)}", FIX)
    try:
        return Lens.of(camera.model, camera.width, camera.height, dict(zip(names, camera.values, strict=False)))
    except ValueError as error:
        fix = "`colmap image_undistorter` writes images and a model of a pinhole camera."
        raise input_error(path, "a pinhole, radial, OpenCV or fisheye camera", str(error), fix) from None


def _lines(path: Path) -> list[str]:
    text = read_text(path, "a text file of COLMAP", FIX)
    return [line.strip() for line in text.splitlines() if not line.lstrip().startswith("#")]


def _cameras_of_text(path: Path) -> dict[int, StoredCamera]:
    cameras = {}
    for line in filter(None, _lines(path)):
        words = line.split()
        try:
            number, width, height = int(words[0]), int(words[2]), int(words[3])
            values = [float(word) for word in words[4:]]
        except (ValueError, IndexError):
            raise input_error(path, "rows `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`", line[:60], FIX) from None
        cameras[number] = StoredCamera(words[1], width, height, values)
    return cameras


def _images_of_text(path: Path) -> list[tuple[str, int, NDArray[np.float64]]]:
    """Name, camera and pose (qw qx qy qz tx ty tz) of each image; a line with its points follows."""
    rows = []
    for line in filter(None, _lines(path)):
        words = line.split(maxsplit=9)
        if _are_numbers(line.split()):  # x, y, point of each point; some programs leave this line out
            continue
        try:
            rows.append((words[9], int(words[8]), np.array([float(word) for word in words[1:8]])))
        except (ValueError, IndexError):
            want = "rows `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME` and rows of points"
            raise input_error(path, want, line[:60], FIX) from None
    return rows


def _are_numbers(words: list[str]) -> bool:
    try:
        return len([float(word) for word in words]) % 3 == 0
    except ValueError:
        return False


def _cameras_of_bytes(path: Path) -> dict[int, StoredCamera]:
    data, cameras = read_bytes(path, "a binary file of COLMAP", FIX).tobytes(), {}
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(min(count, MOST_IMAGES)):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        name = list(MODELS)[model] if 0 <= model < len(MODELS) else f"number {model}"
        size = len(MODELS.get(name, "").split())
        cameras[number] = StoredCamera(name, width, height, list(struct.unpack_from(f"<{size}d", data, at + 24)))
        at += 24 + 8 * size
    return cameras


def _images_of_bytes(path: Path) -> list[tuple[str, int, NDArray[np.float64]]]:
    """As `_images_of_text`."""
    data, rows = read_bytes(path, "a binary file of COLMAP", FIX).tobytes(), []
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(min(count, MOST_IMAGES)):
        _, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.find(b"\0", at + 64)
        if end < 0:
            raise IndexError
        (points,) = struct.unpack_from("<Q", data, end + 1)
        rows.append((data[at + 64 : end].decode(), camera, np.array(pose)))
        at = end + 9 + 24 * points
    if at > len(data):
        raise IndexError
    return rows
