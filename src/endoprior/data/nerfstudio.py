"""Reader of `transforms.json` of nerfstudio and instant-ngp: poses are camera to world, in OpenGL axes.

docs.nerf.studio describes it under "data conventions".
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.config import DataConfig
from .files import file_below
from .formats import DatasetFormat
from .images import read_color
from .lens import COEFFICIENTS, Lens
from .posed_images import PosedImage, load_posed
from .poses import POSES, ROTATION_TOLERANCE, demand_rotations
from .reading import read_json, read_matrix
from .sequence import FrameSequence

FILE = "transforms.json"
UNDISTORT = "undistort the images and write fl_x, fl_y, cx, cy of a PINHOLE camera."
OTHER_POWERS = ("k4", "k5", "k6")
"""Coefficients that mean another thing in nerfstudio than in OpenCV, unless the lens is a fisheye."""
FIX = "write it as docs.nerf.studio describes."
NAMES = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "camera_angle_x": "angle", "w": "w", "h": "h"}
NAMES |= {name: name for name in COEFFICIENTS}  # keys of the lens, in the whole file or in a frame, and our names
TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL camera axes (x right, y up, z backward)


def is_nerfstudio(path: Path) -> bool:
    """Whether a folder has `transforms.json`, and is not complete in the EndoNeRF layout."""
    complete = all((path / name).exists() for name in (POSES, "masks", "depth"))
    return (path / FILE).is_file() and not complete


def load_nerfstudio(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open the images that the file names."""
    file = path / FILE
    stored, frames = _frames(file)
    to_world = [_to_world(file, frame) for frame in frames]
    demand_rotations(file, np.stack(to_world)[:, :3, :3], "the poses", "export them again.")
    lenses: dict[str, Lens] = {}
    posed = []
    for index, (frame, pose) in enumerate(zip(frames, to_world, strict=True)):
        image = _image(path, file, frame, index)
        lens = _lens(file, image, stored | frame, index, lenses)
        mask, depth = (
            file_below(path, name, file) if isinstance(name := frame.get(key), str) else None
            for key in ("mask_path", "depth_file_path")
        )
        time = frame.get("time")
        time = time if isinstance(time, int | float) else None
        posed.append(PosedImage(image, lens, np.linalg.inv(pose).astype(np.float64), mask, depth, time))
    return load_posed(path, cfg, file, posed, [file], [])


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
    if not np.allclose(to_world[3], (0, 0, 0, 1), rtol=0, atol=ROTATION_TOLERANCE):
        raise input_error(file, "poses with a last row 0 0 0 1", f"{to_world[3].tolist()}", FIX)
    return to_world @ TO_OPENCV


def _image(path: Path, file: Path, frame: dict[str, Any], index: int) -> Path:
    """The image of a frame."""
    image = file_below(path, _name(file, frame, index), file)
    return image if image.suffix else image.with_name(f"{image.name}.png")  # without a suffix in Blender's data


def _lens(file: Path, image: Path, stored: dict[str, Any], index: int, lenses: dict[str, Lens]) -> Lens:
    """The lens of a frame, whose own entries are among the `stored` ones; `lenses` keeps one object per lens."""
    values, model = _parameters(file, image, stored)
    key = repr((model, sorted(values.items())))
    if key not in lenses:
        try:
            lenses[key] = Lens.of(model, int(values["w"]), int(values["h"]), values)
        except ValueError as error:
            want = "fl_x and a PINHOLE, OPENCV or OPENCV_FISHEYE camera"
            raise input_error(file, want, f"{error} in frame {index}", UNDISTORT) from None
    return lenses[key]


def _parameters(file: Path, image: Path, stored: dict[str, Any]) -> tuple[dict[str, float], str]:
    """The numbers of a lens, and COLMAP's name of the camera model, which the file may not give."""
    values: dict[str, float] = {}
    for key, ours in NAMES.items():
        value = stored.get(key)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise input_error(file, f"{key} to be a number", repr(value)[:60], FIX)
        values[ours] = float(value)
    if not {"w", "h"} <= values.keys():
        values["h"], values["w"] = (float(side) for side in read_color(image).shape[:2])
    angle = values.pop("angle", 0.0)
    if "fx" not in values and 0 < angle < math.pi:
        values["fx"] = values["w"] / 2 / math.tan(angle / 2)
    model = "OPENCV_FISHEYE" if stored.get("is_fisheye") else str(stored.get("camera_model") or "")
    model = {"PERSPECTIVE": "OPENCV"}.get(model, model)
    if not model.endswith("FISHEYE") and (more := [name for name in OTHER_POWERS if values.get(name)]):
        raise input_error(file, "k1, k2, k3, p1, p2", f"{more[0]} of another polynomial than OpenCV's", UNDISTORT)
    model = re.sub(r"[^A-Z_]", "", model.upper())
    return values, model or ("OPENCV" if values.keys() & {*COEFFICIENTS} else "PINHOLE")


FORMAT = DatasetFormat(is_nerfstudio, load_nerfstudio)
