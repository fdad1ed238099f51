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

from ..core.checks import InputError, input_error
from .calibration import Calibration, Intrinsics, Size, written_in_order
from .calibration_tables import HINT, plain, read_table

Unit = Literal["auto", "mm", "cm", "m"]
MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
MAX_CALIBRATION_PX = 1e6  # largest plausible image size, focal length or principal point, px
METERS_BELOW = 0.05  # A T shorter than this is in meters: no stereo endoscope has a baseline of 0.05 mm
MIN_SKEW = 1e-3  # share of the focal length above which the skew of K would move pixels: OpenCV ignores it

MATRIX = (
    "k", "m", "cameramatrix", "mtx", "intrinsics", "intrinsic", "intrinsicmatrix", "cammatrix", "cameramat", "matrix",
)  # fmt: skip
FOCAL_X, FOCAL_Y = ("fx", "fcx", "flx"), ("fy", "fcy", "fly")
CENTER_X, CENTER_Y = ("cx", "ccx", "ppx", "u0"), ("cy", "ccy", "ppy", "v0")
SIDES = [names.split() for names in (
    "left right", "cam0 cam1", "camera0 camera1", "camera1 camera2", "cam1 cam2", "l r", "1 2", "0 1",
)]  # how files name the left and the right camera  # fmt: skip
PREFIXES = ("", "camera", "cam", "intrinsics", "calibration")  # what files put before the values of an only camera
ROTATION = ("r", "rotation", "rot", "rotationmatrix", "rstereo", "om")
TRANSLATION = ("t", "translation", "trans", "translationvector", "tvec", "tstereo")
LEFT_TO_RIGHT, RIGHT_TO_LEFT = "tcncnm1", "stereotc1c2"  # 4x4 poses of Kalibr and ORB-SLAM, in m
SIZE_PAIRS = (("width", "height"), ("imagewidth", "imageheight"), ("resx", "resy"), ("w", "h"))
SIZES = ("imagesize", "resolution", "size", "imgsize", "imageshape", "imgshape", "shape", "dimensions")
# Names of all coefficients together.
VECTORS = (
    "d", "dist", "distortion", "distcoeffs", "distcoeff", "distcoef", "distortioncoefficients", "distortioncoeffs",
    "distortioncoeff", "distortionparameters", "distortionparams", "distortionvector", "distcoefficients", "kc",
)  # fmt: skip
RADIAL, TANGENTIAL = ("radialdistortion", "radial"), ("tangentialdistortion", "tangential")  # as MATLAB calls them
BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # single coefficients, in OpenCV's order
FISHEYE = ("k1", "k2", "k3", "k4")
MODEL_NAMES = ("distortionmodel", "distortiontype", "projection")  # of the distortion: every value must be known
# These may also hold the product's name: only known models count.
LENS_NAMES = ("model", "type", "cameramodel", "cameratype", "modeltype", "lensmodel", "lenstype", "camera", "lens")
FLAGS = ("fisheye", "isfisheye", "fisheyemodel", "usefisheye")
USUAL = (
    "", "none", "plumbbob", "radtan", "radialtangential", "rationalpolynomial", "rational", "brown", "brownconrady",
    "opencv", "fullopencv", "pinhole", "simplepinhole", "perspective", "radial", "simpleradial", "standard", "frame",
    "rectified", "opencv5", "opencv4", "opencv8",
)  # fmt: skip
FISHEYES = ("fisheye", "equidistant", "kannalabrandt", "equi", "kb4", "kb8", "kb")
# Other models are rejected by name.
OTHERS = (
    "thinprism", "fov", "omni", "omnidirectional", "mei", "ucm", "eucm", "doublesphere", "ds", "scaramuzza", "ocam",
    "division", "spherical", "equirectangular", "cahv", "orthographic", "stereographic", "equisolid",
)  # fmt: skip


class _Values(dict[str, Any]):
    """Values of a calibration, or of one camera, by plain names; errors name the file."""

    def __init__(self, values: Mapping[str, Any], path: Path) -> None:
        super().__init__(values)
        self.path = path

    def error(self, expected: str, got: str, fix: str = HINT) -> InputError:
        return input_error(self.path, expected, got, fix)

    def part(self, side: str) -> _Values:
        """The values whose name has a side before or behind it, by the rest of the name."""
        if not side:
            return self
        behind = {n.removesuffix(side): value for n, value in self.items() if n.endswith(side) and n != side}
        before = {n.removeprefix(side): value for n, value in self.items() if n.startswith(side)}
        return _Values(behind | before, self.path)

    def first(self, names: Iterable[str]) -> str | None:
        return next((name for name in names if name in self), None)

    @property
    def matrix(self) -> str | None:
        """Name of the camera matrix."""
        return next((name for name in MATRIX if name in self and np.ndim(self[name]) > 0), None)

    @property
    def has_camera(self) -> bool:
        return self.matrix is not None or self.first(FOCAL_X) is not None

    def array(self, name: str, shape: tuple[int, ...] = (-1,), of: str = "") -> NDArray:
        """A value as a finite array of this shape; without one, it becomes a vector."""
        try:
            array = np.asarray(self[name], np.float64).reshape(shape)
        except (TypeError, ValueError, OverflowError):
            want = "to be a number or numbers" if shape == (-1,) else f"to have {'x'.join(map(str, shape))} numbers"
            raise self.error(f"{name}{of} {want}", repr(self[name])[:60]) from None
        if not np.isfinite(array).all():
            raise self.error(f"{name}{of} to be finite", "NaN or infinity", "Calibrate again.")
        return array

    def number(self, names: tuple[str, ...], otherwise: float | None = None) -> float:
        """A finite number, under the first of these names that there is."""
        name = self.first(names)
        value = otherwise if name is None else self[name]
        try:
            number = float(value)  # pyright: ignore[reportArgumentType]
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not math.isfinite(number):
            raise self.error(f"{name or names[0]} to be a number", repr(value)[:60], "Correct it.")
        return number


def read_calibration(path: Path, unit: Unit = "auto") -> Calibration:
    """Read the calibration of one or two cameras.

    Args:
        path: of any format of `calibration_tables`.
        unit: of T; "auto" uses the name in the file (`T_mm`), else mm, or m if T is shorter than 0.05.
    Raises:
        InputError: the file is unreadable, or a quantity is missing, malformed or of a model that is not known.
    """
    table = _Values(read_table(path), path)
    sides = [(table.part(left), table.part(right)) for left, right in SIDES]
    single = [(table.part(prefix), None) for prefix in PREFIXES]
    left_side, right_side = next((pair for pair in (*sides, *single) if pair[0].has_camera), (table.part("left"), None))
    right_side = right_side if right_side and right_side.has_camera else None
    if not left_side.has_camera:
        _is_fisheye(table)  # a model that is not known is the better reason
        raise table.error("the left camera matrix", f"only {', '.join(list(table)[:6])}")
    left, is_stated = _camera(left_side, table, "left" if right_side else "only")
    right = rotation = translation = None
    if right_side:
        right, right_is_stated = _camera(right_side, table, "right")
        is_stated |= right_is_stated
        rotation, translation = _relative_pose(table, left_side, right_side, unit)
    elif (baseline := _baseline(table, left, unit)) is not None:
        right, rotation, translation = left, np.eye(3), np.array([-baseline, 0.0, 0.0])
    size, notes = _size([left_side, table.part("camera"), table], [left, *([right] if right else [])])
    layout = table.get("layout") if isinstance(table.get("layout"), str) else None
    if not is_stated:
        notes.append(f"{path}: no lens distortion is stated; the images count as undistorted")
    if left.fisheye:
        notes.append(f"{path}: the lens is a fisheye (equidistant), and is undistorted as one")
    return Calibration(left, right, rotation, translation, size, layout, path.name == "sequence.json", tuple(notes))


def _camera(local: _Values, table: _Values, which: str) -> tuple[Intrinsics, bool]:
    """One camera of its own values, and of those for both, such as the lens model; and whether a lens is stated."""
    # Words and flags of the whole file describe both lenses; numbers do not. Which model it is comes before the matrix:
    # those that are not read have other numbers.
    whole = table.part("camera") | table
    shared = {n: v for n, v in whole.items() if isinstance(v, str | bool) or "fisheye" in n}
    distortion, fisheye, is_stated = _lens(_Values(shared | local, local.path))
    if name := local.matrix:
        shape = (4,) if np.size(local[name]) == 4 else (3, 3)
        matrix = local.array(name, shape, f" of the {which} camera")
        if shape == (4,):
            matrix = np.array([[matrix[0], 0, matrix[2]], [0, matrix[1], matrix[3]], [0, 0, 1.0]])
    else:
        if missing := [names[0] for names in (FOCAL_Y, CENTER_X, CENTER_Y) if local.first(names) is None]:
            want = f"fx, fy, cx, cy (fc_x, fc_y, cc_x, cc_y) of the {which} camera"
            raise local.error(want, f"no {missing[0]}", "Complete it.")
        fx, fy, cx, cy = map(local.number, (FOCAL_X, FOCAL_Y, CENTER_X, CENTER_Y))
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    plausible = np.abs(matrix).max() < MAX_CALIBRATION_PX and np.abs(distortion).max(initial=0) < MAX_CALIBRATION_PX
    if not (plausible and matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.allclose(matrix[2], (0, 0, 1))):
        raise local.error("a camera matrix (fx 0 cx; 0 fy cy; 0 0 1)", str(matrix.tolist()), "Correct it.")
    if max(abs(matrix[0, 1]), abs(matrix[1, 0])) > MIN_SKEW * matrix[0, 0]:
        raise local.error("a camera matrix without skew", str(matrix.tolist()), "Calibrate without skew.")
    # Files of this package count pixel centers from 0.5; OpenCV and all others count them from 0.
    ours = local.path.name == "sequence.json" or table.first(("flx", "leftflx"))
    shift = 0.5 - table.number(("pixelcenter",), 0.5 if ours else 0.0)
    center = np.array([[0, 0, shift], [0, 0, shift], [0, 0, 0]])
    return Intrinsics(matrix + center, distortion, fisheye), is_stated


def _relative_pose(table: _Values, left: _Values, right: _Values, unit: Unit) -> tuple[NDArray, NDArray]:
    """R and T of x_right = R x_left + T, T in mm."""
    for name in (LEFT_TO_RIGHT, RIGHT_TO_LEFT):
        for part in (right, table):
            if name in part:
                pose = part.array(name, (4, 4))
                pose = np.linalg.inv(pose) if name == RIGHT_TO_LEFT and np.linalg.det(pose) else pose
                return _rotation(part, pose[:3, :3]), _in_mm(pose[:3, 3], "m" if unit == "auto" else unit)
    for part in (table, right):
        rotation, in_mm = part.first(ROTATION), part.first([name + "mm" for name in TRANSLATION])
        translation = in_mm or part.first(TRANSLATION)
        if rotation and translation:
            turn = part.array(rotation, (3,) if np.size(part[rotation]) == 3 else (3, 3))
            turn = np.asarray(cv2.Rodrigues(turn)[0]) if turn.size == 3 else turn
            return _rotation(part, turn), _in_mm(part.array(translation, (3,)), "mm" if in_mm else unit)
    turns = [part.first(("r", "rectificationmatrix", "rect")) for part in (left, right)]
    projections = [part.first(("p", "projectionmatrix")) for part in (left, right)]
    if all((*turns, *projections)):
        pairs = zip((left, right), turns, strict=True)
        r1, r2 = (_rotation(part, part.array(str(name), (3, 3))) for part, name in pairs)
        p2 = right.array(str(projections[1]), (3, 4))
        return r2.T @ r1, _in_mm(r2.T @ np.array([p2[0, 3] / p2[0, 0], p2[1, 3] / p2[1, 1], 0.0]), unit)
    missing = "T" if table.first(ROTATION) else "R"
    raise table.error("the relative pose of the cameras (R, T)", f"no {missing}")


def _rotation(values: _Values, matrix: NDArray) -> NDArray:
    if np.abs(matrix.T @ matrix - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
        raise values.error("R to be a rotation", "another matrix", "Write R as 3x3, row by row.")
    return matrix


def _in_mm(translation: NDArray, unit: Unit) -> NDArray:
    if unit == "auto":
        unit = "m" if 0 < np.linalg.norm(translation) < METERS_BELOW else "mm"
    return translation * MM_PER_UNIT[unit]


def _baseline(table: _Values, left: Intrinsics, unit: Unit) -> float | None:
    """Distance, mm, of the cameras of a rectified pair of which the file has one matrix; None without any."""
    if table.get("baselinemm") is not None:
        return table.number(("baselinemm",))
    if (name := table.first(("stereob", "camerabf"))) is not None:  # ORB-SLAM: m, or m times fx
        value = table.number((name,)) / (left.matrix[0, 0] if name == "camerabf" else 1.0)
        return value * MM_PER_UNIT["m" if unit == "auto" else unit]
    return None


def _size(parts: list[_Values], cameras: list[Intrinsics]) -> tuple[Size | None, list[str]]:
    """(width, height) of the calibration's images and a note; None if the file does not state it."""
    for part in parts:
        for a, b in SIZE_PAIRS:
            if a in part and b in part:
                return _whole(part, (part[a], part[b])), []
        for name in SIZES:
            if np.size(part.get(name, 0)) in (2, 3):
                size = _whole(part, tuple(np.ravel(part[name])[:2]))
                ordered = written_in_order(size, cameras)
                words = f"{part.path}: {name} {list(size)} is read as height, width: the principal point says so"
                return ordered, [words] if ordered != size else []
    return None, []


def _whole(part: _Values, found: tuple[Any, ...]) -> Size:
    try:
        width, height = (int(float(v)) for v in found)
    except (TypeError, ValueError, OverflowError):
        raise part.error("width and height in px", repr(found)[:60], "Correct them.") from None
    if not (1 <= width < MAX_CALIBRATION_PX and 1 <= height < MAX_CALIBRATION_PX):
        raise part.error("width and height in px", f"{width}x{height}", "Correct them.")
    return width, height


def _lens(local: _Values) -> tuple[NDArray, bool, bool]:
    """Distortion coefficients, whether they are those of a fisheye, and whether the file has any."""
    fisheye = _is_fisheye(local)
    found = _coefficients(local, fisheye)
    if found is None:
        if unread := [name for name in local if "dist" in name.replace("distance", "") and _holds_numbers(local[name])]:
            fix = "Name the coefficients `distortion`, or k1 k2 p1 p2 k3."
            raise local.error("a known name of the distortion", unread[0], fix)
        return np.zeros(4 if fisheye else 0), fisheye, fisheye
    if fisheye:
        if found[4:].any():
            raise local.error("4 coefficients of a fisheye", str(len(found)), "Correct them.")
        return np.pad(found[:4], (0, 4 - len(found[:4]))), True, True
    if len(found) not in (0, 1, 2, 3, 4, 5, 8, 12, 14):
        raise local.error("4, 5, 8, 12 or 14 distortion coefficients", str(len(found)), "Correct them.")
    if len(found) == 3:  # three radial ones: OpenCV has the third behind the two tangential ones
        found = np.array([found[0], found[1], 0, 0, found[2]])
    return np.pad(found, (0, 4 - len(found))) if 0 < len(found) < 4 else found, False, True


def _is_fisheye(local: _Values) -> bool:
    """Whether the file names a fisheye model; InputError for a model that is not known."""

    def among(model: str, names: tuple[str, ...]) -> bool:
        return any(model == name or (len(name) > 4 and name in model) for name in names)

    want = "a lens of OpenCV's usual model (plumb_bob, radtan, rational_polynomial) or a fisheye (equidistant)"
    fix = "Undistort the video first, or calibrate with one of these."
    fisheye = any(plain(str(local.get(name))) in ("1", "10", "true", "yes") for name in FLAGS)
    for name in (*MODEL_NAMES, *LENS_NAMES):
        if not isinstance(words := local.get(name), str):
            continue
        model, is_fisheye = plain(words), among(plain(words), FISHEYES)
        is_unknown = name in MODEL_NAMES and not is_fisheye and model not in USUAL
        if among(model, OTHERS) or is_unknown:
            raise local.error(want, words[:60], fix)
        fisheye |= is_fisheye
    if "xi" in local:
        raise local.error(want, "xi, of an omnidirectional lens", fix)
    return fisheye


def _coefficients(local: _Values, fisheye: bool) -> NDArray | None:
    """What the file has, in one vector; None without any."""
    for name in VECTORS:
        if name in local and not isinstance(local[name], str) and local[name] is not None:
            return local.array(name)
    if name := local.first(RADIAL):
        radial, other = local.array(name), local.first(TANGENTIAL)
        bent = local.array(other) if other else np.zeros(2)
        return np.concatenate([np.pad(radial, (0, 3))[:2], bent[:2], radial[2:3]])
    single = [name for name in BROWN if local.get(name) is not None and np.ndim(local[name]) == 0]
    singles = {name: local.array(name)[0] for name in single}
    if not singles:
        return None
    if fisheye:
        return np.array([singles.get(name, 0.0) for name in FISHEYE])
    if "k4" in singles and not {"p1", "k5", "k6"} & singles.keys():
        fix = "Add `distortion_model: equidistant` for a fisheye, or k5 and k6."
        raise local.error("the model of the distortion beside k1 k2 k3 k4", "none", fix)
    return np.array([singles.get(name, 0.0) for name in BROWN[: 8 if {"k4", "k5", "k6"} & singles.keys() else 5]])


def _holds_numbers(value: Any) -> bool:
    try:
        return bool(np.any(np.asarray(value, np.float64)))
    except (TypeError, ValueError, OverflowError):
        return False
