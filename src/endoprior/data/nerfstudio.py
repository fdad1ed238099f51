"""Reader of `transforms.json` of nerfstudio and instant-ngp: poses are camera to world, in OpenGL axes.

docs.nerf.studio describes it under "data conventions".
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.config import DataConfig
from .colmap import present
from .files import in_order, read_json, read_matrix
from .formats import Format
from .images import read_color
from .lens import COEFFICIENTS, Lens, model_of
from .posed_images import PosedImage, load_posed
from .sequence import FrameSequence

FILE = "transforms.json"
UNDISTORT = "undistort the images and write fl_x, fl_y, cx, cy of a PINHOLE camera."
OTHER_POWERS = ("k4", "k5", "k6")
"""Coefficients that mean another thing in nerfstudio than in OpenCV, unless the lens is a fisheye."""
FIX = "write it as docs.nerf.studio describes."
NAMES = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "camera_angle_x": "angle"} | {k: k for k in COEFFICIENTS}
"""Keys of the lens, in the whole file or in a frame, and our names."""
TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL camera axes (x right, y up, z backward) to OpenCV's."""
MM_PER_M = 1000.0


def is_nerfstudio(path: Path) -> bool:
    """Whether a folder has `transforms.json`, and is not complete in the EndoNeRF layout."""
    complete = all((path / name).exists() for name in ("poses_bounds.npy", "masks", "depth"))
    return (path / FILE).is_file() and not complete


def load_nerfstudio(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open the images that the file names, by their times if it has them, else in the order of their names."""
    file = path / FILE
    stored, frames = _frames(file)
    lenses: dict[str, Lens] = {}
    posed = [(_posed(path, file, stored, frame, index, lenses), frame) for index, frame in enumerate(frames)]
    times = [frame.get("time") for frame in frames]
    if all(isinstance(time, int | float) for time in times) and len({*times}) == len(times):
        posed.sort(key=lambda each: each[1]["time"])
    else:
        rank = {file: i for i, file in enumerate(in_order(each.file for each, _ in posed))}
        posed.sort(key=lambda each: rank[each[0].file])
    remarks: list[str] = []
    images = present(file, [each for each, _ in posed], remarks)
    has_depth = any(each.depth for each in images)
    if has_depth:
        remarks.append(f"{file}: depth in mm and poses in m, as nerfstudio has them")
    return load_posed(path, cfg, file, images, [file], remarks, MM_PER_M if has_depth else None)


def read_poses(file: Path) -> list[tuple[str, NDArray[np.float64]]]:
    """The name of the image of each frame, and its (4, 4) camera-to-world in OpenCV axes, in units of the file."""
    return [(_name(file, frame, i), _to_world(file, frame)) for i, frame in enumerate(_frames(file)[1])]


def _frames(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """All of the file, and its frames."""
    stored = read_json(file, FIX)
    frames = stored.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise input_error(file, "a list frames", type(frames).__name__ if frames is not None else "no such key", FIX)
    if stored.get("from_na"):
        raise input_error(file, "OpenGL camera axes", "those of NeuS2 (from_na)", "export it for nerfstudio.")
    return stored, frames


def _name(file: Path, frame: dict[str, Any], index: int) -> str:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise input_error(file, f"file_path in frame {index}", repr(name), FIX)
    return name


def _to_world(file: Path, frame: dict[str, Any]) -> NDArray[np.float64]:
    rows = frame.get("transform_matrix")
    shape = (3, 4) if isinstance(rows, list) and len(rows) == 3 else (4, 4)
    to_world = np.eye(4)
    to_world[: shape[0]] = read_matrix(file, frame, "transform_matrix", shape)
    return to_world @ TO_OPENCV


def _posed(
    path: Path, file: Path, stored: dict[str, Any], frame: dict[str, Any], index: int, lenses: dict[str, Lens]
) -> PosedImage:
    image = _below(path, file, _name(file, frame, index))
    if not image.suffix:  # as in Blender's data
        image = image.with_name(f"{image.name}.png")
    mask, depth = (frame.get(key) for key in ("mask_path", "depth_file_path"))
    return PosedImage(
        image,
        _lens(file, image, stored | frame, index, lenses),
        np.linalg.inv(_to_world(file, frame)),
        _below(path, file, mask) if isinstance(mask, str) else None,
        _below(path, file, depth) if isinstance(depth, str) else None,
    )


def _below(path: Path, file: Path, name: str) -> Path:
    """A file that `transforms.json` names."""
    if not (path / name).is_relative_to(path):
        raise input_error(file, "paths from its folder", name[:80], "write paths relative to the file.")
    return path / name


def _lens(file: Path, image: Path, stored: dict[str, Any], index: int, lenses: dict[str, Lens]) -> Lens:
    """The lens of a frame, the same object for the same numbers."""
    values = {}
    for key in (*NAMES, "w", "h"):
        value = stored.get(key)
        if value is not None and (
            isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value)
        ):
            raise input_error(file, f"{key} to be a number", repr(value)[:60], FIX)
        if value is not None:
            values[NAMES.get(key, key)] = float(value)
    if not {"w", "h"} <= values.keys():
        values["h"], values["w"] = (float(side) for side in read_color(image).shape[:2])
    width, angle = values["w"], values.pop("angle", 0.0)
    if "fx" not in values and 0 < angle < math.pi:
        values["fx"] = width / 2 / math.tan(angle / 2)
    model = str(stored.get("camera_model") or "")
    if stored.get("is_fisheye"):
        model = "OPENCV_FISHEYE"
    if model == "PERSPECTIVE":
        model = "OPENCV"
    if not model.endswith("FISHEYE") and (more := [name for name in OTHER_POWERS if values.get(name)]):
        raise input_error(file, "k1, k2, k3, p1, p2", f"{more[0]} of another polynomial than OpenCV's", UNDISTORT)
    key = repr((model, sorted(values.items())))
    if key not in lenses:
        try:
            lenses[key] = Lens.of(model_of(values, model), int(width), int(values["h"]), values)
        except ValueError as error:
            want = "fl_x and a PINHOLE, OPENCV or OPENCV_FISHEYE camera"
            raise input_error(file, want, f"{error} in frame {index}", UNDISTORT) from None
    return lenses[key]


FORMAT = Format(is_nerfstudio, load_nerfstudio)
