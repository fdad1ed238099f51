"""Reader of folders with `images/` and COLMAP's sparse model, text or binary: poses are world to camera, OpenCV axes.

https://colmap.github.io/format.html describes the files. Binary numbers are little endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..core.checks import input_error
from ..core.config import DataConfig
from .files import IMAGE_SUFFIXES, entries, file_below
from .formats import DatasetFormat
from .lens import MODELS, Lens
from .posed_images import PosedImage, load_posed
from .poses import POSES
from .reading import read_bytes, read_text
from .sequence import FrameSequence

FIX = "export the model again."
MAX_IMAGES = 1_000_000
PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")  # where programs put the model
ImageRow = tuple[str, int, NDArray[np.float64]]
"""Name, camera and pose (qw qx qy qz tx ty tz) of an image."""
Stored = TypeVar("Stored")


class StoredCamera(NamedTuple):
    """One camera as the file has it."""

    model: str  # one of `MODELS`, or another word
    width: int
    height: int
    values: list[float]


class RegisteredImage(NamedTuple):
    """One image of a model."""

    name: str  # its file, below the folder of images
    lens: Lens
    world_to_camera: NDArray[np.float64]  # (4, 4), OpenCV axes, in units of the model


def read_colmap(folder: Path) -> tuple[list[RegisteredImage], list[Path]]:
    """The registered images of a model, in the order of its file, and the files that were read."""
    suffix = ".bin" if (folder / "images.bin").exists() else ".txt"
    cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
    lenses = {number: _lens(cameras, each) for number, each in read_cameras(cameras).items()}
    rows = _read(images, _images_of_bytes, _images_of_text)
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
    """The cameras of `cameras.txt` or `cameras.bin` by their numbers."""
    return _read(path, _cameras_of_bytes, _cameras_of_text)


def _read(path: Path, of_bytes: Callable[[bytes], Stored], of_text: Callable[[Path, list[str]], Stored]) -> Stored:
    try:
        if path.suffix == ".bin":
            return of_bytes(read_bytes(path, "a binary file of COLMAP", FIX).tobytes())
        lines = [line.strip() for line in read_text(path, "a text file of COLMAP", FIX).splitlines()]
        return of_text(path, [line for line in lines if line and not line.startswith("#")])
    except (struct.error, IndexError, UnicodeDecodeError):
        raise input_error(path, "a model of COLMAP", f"a {path.suffix} file that ends too early", FIX) from None


def _lens(path: Path, camera: StoredCamera) -> Lens:
    names = MODELS.get(camera.model, "").split()
    if names and len(names) != len(camera.values):
        raise input_error(path, f"{len(names)} parameters of {camera.model}", f"{len(camera.values)}", FIX)
    try:
        return Lens.of(camera.model, camera.width, camera.height, dict(zip(names, camera.values, strict=False)))
    except ValueError as error:
        fix = "`colmap image_undistorter` writes images and a model of a pinhole camera."
        raise input_error(path, "a pinhole, radial, OpenCV or fisheye camera", str(error), fix) from None


def _cameras_of_text(path: Path, lines: list[str]) -> dict[int, StoredCamera]:
    cameras = {}
    for line in lines:
        words = line.split()
        try:
            number, width, height = int(words[0]), int(words[2]), int(words[3])
            values = [float(word) for word in words[4:]]
        except (ValueError, IndexError):
            raise input_error(path, "rows `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`", line[:60], FIX) from None
        cameras[number] = StoredCamera(words[1], width, height, values)
    return cameras


def _images_of_text(path: Path, lines: list[str]) -> list[ImageRow]:
    rows = []  # a line with its points follows each image
    for line in lines:
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


def _cameras_of_bytes(data: bytes) -> dict[int, StoredCamera]:
    cameras, (count,), at = {}, struct.unpack_from("<Q", data), 8
    for _ in range(min(count, MAX_IMAGES)):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        name = list(MODELS)[model] if 0 <= model < len(MODELS) else f"number {model}"
        size = len(MODELS.get(name, "").split())
        cameras[number] = StoredCamera(name, width, height, list(struct.unpack_from(f"<{size}d", data, at + 24)))
        at += 24 + 8 * size
    return cameras


def _images_of_bytes(data: bytes) -> list[ImageRow]:
    rows, (count,), at = [], struct.unpack_from("<Q", data), 8
    for _ in range(min(count, MAX_IMAGES)):
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


def model_folder(path: Path) -> Path | None:
    """The folder of the model in a project folder; None if there is none."""
    for place in PLACES:
        for suffix in (".bin", ".txt"):
            if all((path / place / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
                return path / place
    return None


def is_colmap(path: Path) -> bool:
    """Whether a folder has images and a model, and no poses of its own."""
    return (path / "images").is_dir() and not (path / POSES).exists() and model_folder(path) is not None


def load_colmap(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open the registered images."""
    model = model_folder(path)
    if model is None:
        fix = "pass the folder that holds images/ and sparse/0/."
        raise input_error(path / PLACES[0], "cameras and images, .bin or .txt", "no such files", fix)
    registered, files = read_colmap(model)
    remarks: list[str] = []
    siblings = entries(model.parent) if model.name.isdigit() else []
    if others := sorted(each.name for each in siblings if each != model and each.name.isdigit()):
        remarks.append(f"{model}: other parts of the model, {', '.join(others)}, are not used")
    posed = [
        PosedImage(file_below(path / "images", each.name, files[1]), each.lens, each.world_to_camera)
        for each in registered
    ]
    own = {file.name for file in entries(path / "images") if file.suffix.lower() in IMAGE_SUFFIXES}
    if missing := len(own - {each.file.name for each in posed}):
        remarks.append(f"{model}: {missing} of {len(own)} images have no pose and are left out")
    return load_posed(path, cfg, model, posed, files, remarks)


FORMAT = DatasetFormat(is_colmap, load_colmap)
