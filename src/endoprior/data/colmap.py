"""Reader of folders with `images/` and COLMAP's sparse model, text or binary: poses are world to camera, OpenCV axes.

https://colmap.github.io/format.html describes the files. Binary numbers are little endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..core.checks import InputError, input_error
from ..core.config import DataConfig
from .files import IMAGE_SUFFIXES, entries, in_order
from .formats import Format
from .lens import MODELS, Lens
from .posed_images import PosedImage, load_posed
from .reading import read_bytes, read_text
from .sequence import FrameSequence

FIX = "export the model again."
MOST_IMAGES = 1_000_000
PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
"""Where programs put the model."""


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
    """The registered images of a model, in the order of its file, and the files that were read."""
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
    """The cameras of `cameras.txt` or `cameras.bin` by their numbers."""
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


def is_colmap(path: Path) -> bool:
    """Whether a folder has images and a model, and no poses of its own."""
    return (path / "images").is_dir() and not (path / "poses_bounds.npy").exists() and model_folder(path) is not None


def load_colmap(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open the registered images, in the order of their names."""
    model = model_folder(path)
    if model is None:
        fix = "pass the folder that holds images/ and sparse/0/."
        raise input_error(path / PLACES[0], "cameras and images, .bin or .txt", "no such files", fix)
    registered, files = read_colmap(model)
    remarks: list[str] = []
    siblings = entries(model.parent) if model.name.isdigit() else []
    if others := sorted(each.name for each in siblings if each != model and each.name.isdigit()):
        remarks.append(f"{model}: other parts of the model, {', '.join(others)}, are not used")
    posed = [PosedImage(path / "images" / each.name, each.lens, each.world_to_camera) for each in registered]
    posed = present(model, posed, remarks)
    own = [file for file in entries(path / "images") if file.suffix.lower() in IMAGE_SUFFIXES]
    if missing := len({file.name for file in own} - {each.file.name for each in posed}):
        remarks.append(f"{model}: {missing} of {len(own)} images have no pose and are left out")
    rank = {file: i for i, file in enumerate(in_order(each.file for each in posed))}
    posed.sort(key=lambda each: rank[each.file])
    return load_posed(path, cfg, model, posed, files, remarks)


def present(source: Path, posed: list[PosedImage], remarks: list[str]) -> list[PosedImage]:
    """The images whose files are there; a remark counts the others."""
    there = [each for each in posed if each.file.is_file()]
    if not there:
        got = f"none of {len(posed)}, such as {posed[0].file}" if posed else "none"
        raise input_error(source, "images that are there", got, "put the images where the file says.")
    if len(there) < len(posed):
        remarks.append(f"{source}: {len(posed) - len(there)} of {len(posed)} images are not there and are left out")
    return there


def model_folder(path: Path) -> Path | None:
    """The folder of the model in a project folder; None if there is none."""
    for place in PLACES:
        for suffix in (".bin", ".txt"):
            if all((path / place / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
                return path / place
    return None


FORMAT = Format(is_colmap, load_colmap)
