"""Read the calibration of one or two cameras from the names and values of its file.

Names are compared without case and punctuation, and every usual name of a quantity is accepted. Two models of lens
distortion are used: OpenCV's usual one (Brown-Conrady, radial and tangential), and its fisheye model (equidistant,
Kannala-Brandt). Four numbers mean different things in each, so a model that is named and not known is an error.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .calibration import Calibration, Intrinsics, written_in_order
from .calibration_tables import HINT, Table, plain, read_table

Unit = Literal["auto", "mm", "cm", "m"]
MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
MOST_PX = 1e6  # largest plausible image size, focal length or principal point, px
METERS_BELOW = 0.05  # A T shorter than this is in meters: no stereo endoscope has a baseline of 0.05 mm
LEAST_SKEW = 1e-3  # share of the focal length above which the skew of K would move pixels: OpenCV ignores it

MATRIX = (
    "k", "m", "cameramatrix", "mtx", "intrinsics", "intrinsic", "intrinsicmatrix", "cammatrix", "cameramat", "matrix",
)  # fmt: skip
FOCAL_X, FOCAL_Y = ("fx", "fcx", "flx"), ("fy", "fcy", "fly")
CENTER_X, CENTER_Y = ("cx", "ccx", "ppx", "u0"), ("cy", "ccy", "ppy", "v0")
SIDES = (
    ("left", "right"), ("cam0", "cam1"), ("camera0", "camera1"), ("camera1", "camera2"), ("cam1", "cam2"),
    ("l", "r"), ("1", "2"), ("0", "1"),
)  # fmt: skip
"""How files name the left and the right camera."""
PREFIXES = ("", "camera", "cam", "intrinsics", "calibration")  # what files put before the values of an only camera
ROTATION = ("r", "rotation", "rot", "rotationmatrix", "rstereo", "om")
TRANSLATION = ("t", "translation", "trans", "translationvector", "tvec", "tstereo")
LEFT_TO_RIGHT, RIGHT_TO_LEFT = "tcncnm1", "stereotc1c2"  # 4x4 poses of Kalibr and ORB-SLAM, in m
SIZE_PAIRS = (("width", "height"), ("imagewidth", "imageheight"), ("resx", "resy"), ("w", "h"))
SIZES = ("imagesize", "resolution", "size", "imgsize", "imageshape", "imgshape", "shape", "dimensions")
VECTORS = (
    "d", "dist", "distortion", "distcoeffs", "distcoeff", "distcoef", "distortioncoefficients", "distortioncoeffs",
    "distortioncoeff", "distortionparameters", "distortionparams", "distortionvector", "distcoefficients", "kc",
)  # fmt: skip
"""Names of all coefficients together."""
RADIAL, TANGENTIAL = ("radialdistortion", "radial"), ("tangentialdistortion", "tangential")
"""MATLAB's names of the two parts."""
BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # names of single coefficients, in OpenCV's order
FISHEYE = ("k1", "k2", "k3", "k4")
MODEL_NAMES = ("distortionmodel", "distortiontype", "projection")
"""Names of the model of the distortion: every value must be known."""
LENS_NAMES = ("model", "type", "cameramodel", "cameratype", "lensmodel", "lenstype", "camera", "lens")
"""Names that may also hold the product's name: only known models count."""
FLAGS = ("fisheye", "isfisheye", "fisheyemodel", "usefisheye")
USUAL = (
    "", "none", "plumbbob", "radtan", "radialtangential", "rationalpolynomial", "rational", "brown", "brownconrady",
    "opencv", "fullopencv", "pinhole", "simplepinhole", "perspective", "radial", "simpleradial", "standard", "frame",
    "rectified", "opencv5", "opencv4", "opencv8",
)  # fmt: skip
FISHEYES = ("fisheye", "equidistant", "kannalabrandt", "equi", "kb4", "kb8", "kb")
OTHERS = (
    "thinprism", "fov", "omni", "omnidirectional", "mei", "ucm", "eucm", "doublesphere", "ds", "scaramuzza", "ocam",
    "division", "spherical", "equirectangular", "cahv", "orthographic", "stereographic", "equisolid",
)  # fmt: skip
"""Other models: they are rejected by name."""


def read_calibration(path: Path, unit: Unit = "auto") -> Calibration:
    """Read the calibration of one or two cameras.

    Args:
        path: of any format of `calibration_tables`.
        unit: of T; "auto" uses the name in the file (`T_mm`), else mm, or m if T is shorter than 0.05.
    Raises:
        InputError: the file is unreadable, or a quantity is missing, malformed or of a model that is not known.
    """
    table = read_table(path)
    left_side, right_side = _sides(table)
    left, has_lens = _camera(left_side, table, path, "left" if right_side else "only")
    right, right_has_lens = _camera(right_side, table, path, "right") if right_side else (None, False)
    if left is None:
        raise input_error(path, "the left camera matrix", f"only {', '.join(list(table)[:6])}", HINT)
    rotation = translation = None
    if right is not None:
        rotation, translation = _relative_pose(table, left_side, right_side, unit, path)
    elif (baseline := _baseline(table, left, unit, path)) is not None:
        right, rotation, translation = left, np.eye(3), np.array([-baseline, 0.0, 0.0])
    size, notes = _size([left_side, _part(table, "camera"), table], [left, right], path)
    layout = table.get("layout") if isinstance(table.get("layout"), str) else None
    if not (has_lens or right_has_lens):
        notes.append(f"{path}: no lens distortion is stated; the images count as undistorted")
    if left.fisheye:
        notes.append(f"{path}: the lens is a fisheye (equidistant), and is undistorted as one")
    return Calibration(left, right, rotation, translation, size, layout, path.name == "sequence.json", tuple(notes))


def _sides(table: Table) -> tuple[Table, Table]:
    """The values of the left and of the right camera, without the names of the sides; those of one camera, and {}."""
    for left, right in SIDES:
        if _has_matrix(found := _part(table, left)):
            other = _part(table, right)
            return found, other if _has_matrix(other) else {}
    for prefix in PREFIXES:
        if _has_matrix(found := _part(table, prefix)):
            return found, {}
    return _part(table, "left"), {}


def _part(table: Table, side: str) -> Table:
    """The values whose name has a side before or behind it, by the rest of the name."""
    if not side:
        return dict(table)
    behind = {name.removesuffix(side): value for name, value in table.items() if name.endswith(side) and name != side}
    return behind | {name.removeprefix(side): value for name, value in table.items() if name.startswith(side)}


def _has_matrix(local: Table) -> bool:
    matrix = any(np.ndim(local[name]) > 0 for name in MATRIX if name in local)
    return matrix or any(name in local for name in FOCAL_X)


def _camera(local: Table, table: Table, path: Path, which: str) -> tuple[Intrinsics | None, bool]:
    """One camera of its own values, and of those for both, such as the lens model; and whether a lens is stated.

    Args:
        which: the camera, a word for messages.
    """
    if name := next((name for name in MATRIX if name in local and np.ndim(local[name]) > 0), None):
        shape = (4,) if np.size(local[name]) == 4 else (3, 3)
        matrix = _array(local[name], f"{name} of the {which} camera", path, shape)
        if shape == (4,):
            matrix = np.array([[matrix[0], 0, matrix[2]], [0, matrix[1], matrix[3]], [0, 0, 1.0]])
    else:
        if not any(name in local for name in FOCAL_X):
            return None, False
        if missing := [names[0] for names in (FOCAL_Y, CENTER_X, CENTER_Y) if _first(local, names) is None]:
            want = f"fx, fy, cx, cy (fc_x, fc_y, cc_x, cc_y) of the {which} camera"
            raise input_error(path, want, f"no {missing[0]}", "Complete it.")
        fx, fy, cx, cy = (_number(local, names, path) for names in (FOCAL_X, FOCAL_Y, CENTER_X, CENTER_Y))
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    # Words and flags of the whole file describe both lenses; numbers do not.
    whole = _part(table, "camera").items(), table.items()
    shared = {n: v for part in whole for n, v in part if isinstance(v, str | bool) or "fisheye" in n}
    distortion, fisheye, is_stated = lens_of(shared | local, path)
    plausible = np.abs(matrix).max() < MOST_PX and np.abs(distortion).max(initial=0) < MOST_PX
    if not (plausible and matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.allclose(matrix[2], (0, 0, 1))):
        raise input_error(path, "a camera matrix (fx 0 cx; 0 fy cy; 0 0 1)", str(matrix.tolist()), "Correct it.")
    if max(abs(matrix[0, 1]), abs(matrix[1, 0])) > LEAST_SKEW * matrix[0, 0]:
        raise input_error(path, "a camera matrix without skew", str(matrix.tolist()), "Calibrate without skew.")
    moved = matrix.copy()
    # Files of this package count pixel centers from 0.5; OpenCV and all others count them from 0.
    ours = path.name == "sequence.json" or any(name in table for name in ("flx", "leftflx"))
    moved[:2, 2] += 0.5 - _number(table, ("pixelcenter",), path, 0.5 if ours else 0.0)
    return Intrinsics(moved, distortion, fisheye), is_stated


def _relative_pose(
    table: Table, left: Table, right: Table, unit: Unit, path: Path
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R and T of x_right = R x_left + T, T in mm."""
    for name in (LEFT_TO_RIGHT, RIGHT_TO_LEFT):
        for part in (right, table):
            if name in part:
                pose = _array(part[name], name, path, (4, 4))
                pose = np.linalg.inv(pose) if name == RIGHT_TO_LEFT and np.linalg.det(pose) else pose
                return _rotation(pose[:3, :3], path), _in_mm(pose[:3, 3], "m" if unit == "auto" else unit)
    for part in (table, right):
        rotation, in_mm = _first(part, ROTATION), _first(part, [name + "mm" for name in TRANSLATION])
        translation = in_mm or _first(part, TRANSLATION)
        if rotation and translation:
            turn = _array(part[rotation], rotation, path, (3,) if np.size(part[rotation]) == 3 else (3, 3))
            turn = cv2.Rodrigues(turn)[0] if turn.size == 3 else turn
            shift = _array(part[translation], translation, path, (3,))
            return _rotation(turn, path), _in_mm(shift, "mm" if in_mm else unit)
    turns = [_first(part, ("r", "rectificationmatrix", "rect")) for part in (left, right)]
    projections = [_first(part, ("p", "projectionmatrix")) for part in (left, right)]
    if all((*turns, *projections)):
        r1 = _rotation(_array(left[turns[0]], turns[0], path, (3, 3)), path)
        r2 = _rotation(_array(right[turns[1]], turns[1], path, (3, 3)), path)
        p2 = _array(right[projections[1]], projections[1], path, (3, 4))
        return r2.T @ r1, _in_mm(r2.T @ np.array([p2[0, 3] / p2[0, 0], p2[1, 3] / p2[1, 1], 0.0]), unit)
    missing = "T" if _first(table, ROTATION) else "R"
    raise input_error(path, "the relative pose of the cameras (R, T)", f"no {missing}", HINT)


def _rotation(matrix: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    if np.abs(matrix.T @ matrix - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
        raise input_error(path, "R to be a rotation", "another matrix", "Write R as 3x3, row by row.")
    return matrix


def _in_mm(translation: NDArray[np.float64], unit: Unit) -> NDArray[np.float64]:
    if unit == "auto":
        unit = "m" if 0 < np.linalg.norm(translation) < METERS_BELOW else "mm"
    return translation * MM_PER_UNIT[unit]


def _baseline(table: Table, left: Intrinsics, unit: Unit, path: Path) -> float | None:
    """Distance, mm, of the cameras of a rectified pair of which the file has one matrix; None without any."""
    if table.get("baselinemm") is not None:
        return _number(table, ("baselinemm",), path)
    if (name := _first(table, ("stereob", "camerabf"))) is not None:  # ORB-SLAM: m, or m times fx
        value = _number(table, (name,), path) / (left.matrix[0, 0] if name == "camerabf" else 1.0)
        return value * MM_PER_UNIT["m" if unit == "auto" else unit]
    return None


def _first(table: Table, names: Iterable[str]) -> str | None:
    return next((name for name in names if name in table), None)


def _array(value: Any, name: str, path: Path, shape: tuple[int, ...] = (-1,)) -> NDArray[np.float64]:
    """A value as a finite array of this shape; of any, it becomes a vector."""
    try:
        array = np.asarray(value, np.float64).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        want = "to be a number or numbers" if shape == (-1,) else f"to have {'x'.join(map(str, shape))} numbers"
        raise input_error(path, f"{name} {want}", repr(value)[:60], HINT) from None
    if not np.isfinite(array).all():
        raise input_error(path, f"{name} to be finite", "NaN or infinity", "Calibrate again.")
    return array


def _number(table: Table, names: tuple[str, ...], path: Path, otherwise: float | None = None) -> float:
    """A finite number from the table, under the first of these names that it has."""
    name = _first(table, names)
    value = otherwise if name is None else table[name]
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise input_error(path, f"{name or names[0]} to be a number", repr(value)[:60], "Correct it.")
    return number


def _size(
    tables: list[Table], cameras: list[Intrinsics | None], path: Path
) -> tuple[tuple[int, int] | None, list[str]]:
    """(width, height) of the calibration's images and a note; None if the file does not state it."""
    for table in tables:
        for a, b in SIZE_PAIRS:
            if a in table and b in table:
                return _whole((table[a], table[b]), path), []
        for name in SIZES:
            if np.size(table.get(name, 0)) in (2, 3):
                size = _whole(tuple(np.ravel(table[name])[:2]), path)
                ordered = written_in_order(size, [camera for camera in cameras if camera])
                words = f"{path}: {name} {list(size)} is read as height, width: the principal point says so"
                return ordered, [words] if ordered != size else []
    return None, []


def _whole(found: tuple[Any, Any], path: Path) -> tuple[int, int]:
    try:
        width, height = (int(float(v)) for v in found)
    except (TypeError, ValueError, OverflowError):
        raise input_error(path, "width and height in px", repr(found)[:60], "Correct them.") from None
    if not (1 <= width < MOST_PX and 1 <= height < MOST_PX):
        raise input_error(path, "width and height in px", f"{width}x{height}", "Correct them.")
    return width, height


def lens_of(local: Mapping[str, Any], path: Path) -> tuple[NDArray[np.float64], bool, bool]:
    """Distortion coefficients, whether they are those of a fisheye, and whether the file has any.

    Args:
        local: values of one camera, by plain names.
        path: the file, for error messages.
    Raises:
        InputError: a model that is not known, or coefficients that do not fit it.
    """
    fisheye = _is_fisheye(local, path)
    found = _coefficients(local, fisheye, path)
    if found is None:
        unread = [name for name in local if "dist" in name.replace("distance", "") and _holds_numbers(local[name])]
        if unread:
            hint = "Name the coefficients `distortion`, or k1 k2 p1 p2 k3."
            raise input_error(path, "a known name of the distortion", unread[0], hint)
        return np.zeros(4 if fisheye else 0), fisheye, fisheye
    if fisheye:
        if len(found) > 4 and found[4:].any():
            raise input_error(path, "4 coefficients of a fisheye", str(len(found)), "Correct them.")
        return np.pad(found[:4], (0, 4 - len(found[:4]))), True, True
    if len(found) not in (0, 1, 2, 3, 4, 5, 8, 12, 14):
        raise input_error(path, "4, 5, 8, 12 or 14 distortion coefficients", str(len(found)), "Correct them.")
    if len(found) == 3:  # three radial ones: OpenCV has the third behind the two tangential ones
        found = np.array([found[0], found[1], 0, 0, found[2]])
    return np.pad(found, (0, 4 - len(found))) if 0 < len(found) < 4 else found, False, True


def _is_fisheye(local: Mapping[str, Any], path: Path) -> bool:
    """Whether the file names a fisheye model."""

    def among(model: str, names: tuple[str, ...]) -> bool:
        return any(model == name or (len(name) > 4 and name in model) for name in names)

    fisheye = any(plain(str(local.get(name))) in ("1", "10", "true", "yes") for name in FLAGS)
    for name in (*MODEL_NAMES, *LENS_NAMES):
        if not isinstance(words := local.get(name), str):
            continue
        model, is_fisheye = plain(words), among(plain(words), FISHEYES)
        is_unknown = name in MODEL_NAMES and not is_fisheye and model not in USUAL
        if among(model, OTHERS) or "xi" in local or is_unknown:
            want = "a lens of OpenCV's usual model (plumb_bob, radtan, rational_polynomial) or a fisheye (equidistant)"
            raise input_error(path, want, words[:60], "Undistort the video first, or calibrate with one of these.")
        fisheye |= is_fisheye
    return fisheye


def _coefficients(local: Mapping[str, Any], fisheye: bool, path: Path) -> NDArray[np.float64] | None:
    """What the file has, in one vector; None without any."""
    for name in VECTORS:
        if name in local and not isinstance(local[name], str) and local[name] is not None:
            return _array(local[name], name, path)
    radial = next((_array(local[name], name, path) for name in RADIAL if name in local), None)
    if radial is not None:
        bent = next((_array(local[name], name, path) for name in TANGENTIAL if name in local), np.zeros(2))
        return np.concatenate([np.pad(radial, (0, 3))[:2], bent[:2], radial[2:3]])
    single = [name for name in BROWN if local.get(name) is not None and np.ndim(local[name]) == 0]
    singles = {name: _array(local[name], name, path)[0] for name in single}
    if not singles:
        return None
    if fisheye:
        return np.array([singles.get(name, 0.0) for name in FISHEYE])
    if "k4" in singles and not {"p1", "k5", "k6"} & singles.keys():
        hint = "Add `distortion_model: equidistant` for a fisheye, or k5 and k6."
        raise input_error(path, "the model of the distortion beside k1 k2 k3 k4", "none", hint)
    return np.array([singles.get(name, 0.0) for name in BROWN[: 8 if {"k4", "k5", "k6"} & singles.keys() else 5]])


def _holds_numbers(value: Any) -> bool:
    try:
        return bool(np.any(np.asarray(value, np.float64)))
    except (TypeError, ValueError, OverflowError):
        return False
