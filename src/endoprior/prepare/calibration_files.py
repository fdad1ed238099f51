"""Read calibration files: OpenCV YAML, plain YAML or JSON, NPZ, and da Vinci ini.

A file becomes a flat table of names and values. Names are compared without case and punctuation, and every usual name
of a quantity is accepted. Nothing in a file is ever executed.
"""

from __future__ import annotations

import configparser
import json
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..data.numpy_files import read_numpy
from ..data.reading import read_text
from ..data.yaml_text import BoundedLoader, load_yaml
from .calibration import Calibration, Intrinsics

Unit = Literal["auto", "mm", "cm", "m"]
MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
MOST_PX = 1e6
"""Largest plausible image size, focal length or principal point, px."""
METERS_BELOW = 0.05
"""A T shorter than this is in meters: no stereo endoscope has a baseline of 0.05 mm."""

MATRIX = ("k", "m", "cameramatrix", "cameramat", "mtx", "intrinsics", "intrinsic", "intrinsicmatrix", "cammatrix")
DISTORTION = ("d", "dist", "distortion", "distcoeffs", "distcoeff", "distortioncoefficients", "distortioncoeffs")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""One camera's distortion as single numbers, in OpenCV's order."""
SIDES = (("left", "right"), ("l", "r"), ("1", "2"), ("0", "1"))
ROTATION = ("r", "rotation", "rot", "rotationmatrix", "rstereo")
TRANSLATION = ("t", "translation", "trans", "translationvector", "tvec", "tstereo")
HINT = "Use the names K_left, distortion_left, K_right, distortion_right, R, T_mm, width, height (docs/prepare.md)."

Table = dict[str, Any]
"""Numbers, arrays and texts, by name in lower case without punctuation."""


def read_calibration(path: Path, unit: Unit = "auto") -> Calibration:
    """Read the calibration of one or two cameras.

    Args:
        path: .yaml, .yml, .json, .npz or .ini.
        unit: of T; "auto" uses the name in the file (`T_mm`), else mm, or m if T is shorter than 0.05.
    Raises:
        InputError: the file is unreadable, or a quantity is missing or malformed.
    """
    table = _read_table(path)
    table = {_plain(name): value for name, value in table.items()}
    size, layout = _size(table, path), table.get("layout") if isinstance(table.get("layout"), str) else None
    if "k1" in table and np.ndim(table["k1"]) == 0:  # coefficients, not the matrices K1 and K2
        table["d"] = [_number(table, name, path, 0.0) for name in COEFFICIENTS]
        table = {name: value for name, value in table.items() if name not in COEFFICIENTS}
    # Files of this package count pixel centers from 0.5; OpenCV and all others count them from 0.
    offset = 0.5 - _number(table, "pixelcenter", path, 0.5 if path.name == "sequence.json" else 0.0)
    if "fcxleft" in table:
        left, right = _da_vinci_camera(table, "left", offset, path), _da_vinci_camera(table, "right", offset, path)
    else:
        left, right = _cameras(table, offset, path)
    if left is None:
        raise input_error(path, "the left camera matrix", f"only {', '.join(list(table)[:6])}", HINT)
    if right is None and table.get("baselinemm") is not None:
        shift = np.array([-_number(table, "baselinemm", path), 0.0, 0.0])
        return Calibration(left, left, np.eye(3), shift, size, layout)
    if right is None:
        return Calibration(left, size=size, layout=layout)
    rotation = _find(table, ROTATION, path, (3, 3))
    in_mm = any(name + "mm" in table for name in TRANSLATION)
    translation = _find(table, (*(name + "mm" for name in TRANSLATION), *TRANSLATION), path, (3,))
    if rotation is None or translation is None:
        missing = "R" if rotation is None else "T"
        raise input_error(path, "the relative pose of the cameras (R, T)", f"no {missing}", HINT)
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise input_error(path, "R to be a rotation", "another matrix", "Write R as 3x3, row by row.")
    if unit == "auto":
        unit = "m" if not in_mm and 0 < np.linalg.norm(translation) < METERS_BELOW else "mm"
    scale = 1.0 if in_mm else MM_PER_UNIT[unit]
    return Calibration(left, right, rotation, translation * scale, size, layout)


def _read_table(path: Path) -> Table:
    """The file as a flat table; nested names are joined, matrices with rows, cols and data become arrays."""
    readers = {".yaml": _read_yaml, ".yml": _read_yaml, ".json": _read_yaml, ".npz": _read_npz, ".ini": _read_ini}
    if path.suffix.lower() not in readers:
        raise input_error(path, "a .yaml, .json, .npz or .ini file", path.suffix or "no suffix", "Convert it.")
    try:
        content = readers[path.suffix.lower()](path)
        if isinstance(content, dict) and content:
            return _flat(content)
    except InputError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, yaml.YAMLError, configparser.Error) as error:
        raise input_error(path, "a readable calibration", " ".join(str(error).split())[:120], "Correct it.") from None
    raise input_error(path, "named values", type(content).__name__, HINT)


class _Loader(BoundedLoader):
    """Safe YAML that also knows OpenCV's matrices."""


for _name in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_name}", lambda loader, node: loader.construct_mapping(node, True))


def _read_yaml(path: Path) -> Any:
    text = read_text(path, "a calibration file", "Check the path.")
    if path.suffix.lower() == ".json":
        return json.loads(text)
    # OpenCV writes "%YAML:1.0", which is not YAML, and tabs or "---" after it.
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]
    return load_yaml("\n".join(lines), _Loader)


def _read_npz(path: Path) -> Table:
    stored = read_numpy(path, "a readable calibration", "Save it again with numpy.savez.")
    if isinstance(stored, np.ndarray):
        raise ValueError("a single array")
    return stored


def _read_ini(path: Path) -> Table:
    parser = configparser.ConfigParser(interpolation=None)
    parser.read_string(read_text(path, "a calibration file", "Check the path."))
    table: Table = {}
    for section in parser.sections():
        side = "left" if "left" in section.lower() else "right" if "right" in section.lower() else section
        for name, value in parser.items(section):
            table[f"{name}_{side}"] = float(value)
    return table


def _flat(content: dict[Any, Any], prefix: str = "") -> Table:
    table: Table = {}
    for name, value in content.items():
        if isinstance(value, dict) and {"rows", "cols", "data"} <= {str(key) for key in value}:
            table[f"{prefix}{name}"] = np.reshape(value["data"], (int(value["rows"]), int(value["cols"])))
        elif isinstance(value, dict) and {"sizes", "data"} <= {str(key) for key in value}:
            table[f"{prefix}{name}"] = np.reshape(value["data"], np.ravel(value["sizes"]))
        elif isinstance(value, dict):
            table |= _flat(value, f"{prefix}{name}.")
        else:
            table[f"{prefix}{name}"] = value
    return table


def _plain(name: str) -> str:
    return "".join(c for c in name.lower() if c.isalnum())


def _find(table: Table, names: tuple[str, ...], path: Path, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """The first of the named values as an array of this shape (-1: any length); None if there is none."""
    for name in names:
        if name not in table:
            continue
        try:
            value = np.asarray(table[name], np.float64)
            value = value.reshape(shape)
        except (TypeError, ValueError, OverflowError):
            want = "x".join(map(str, shape)).replace("-1", "k")
            raise input_error(path, f"{name} to have {want} numbers", repr(table[name])[:60], HINT) from None
        if not np.isfinite(value).all():
            raise input_error(path, f"{name} to be finite", "NaN or infinity", "Calibrate again.")
        return value
    return None


def _cameras(table: Table, offset: float, path: Path) -> tuple[Intrinsics | None, Intrinsics | None]:
    """Left and right camera, under the first pair of side names in the table; or one camera without side names."""
    for left_name, right_name in SIDES:
        if left := _camera(table, left_name, offset, path):
            return left, _camera(table, right_name, offset, path)
    return _camera(table, "", offset, path) or _plain_pinhole(table, offset, path), None


def _camera(table: Table, side: str, offset: float, path: Path) -> Intrinsics | None:
    def spelled(names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(spelling for name in names for spelling in (name + side, side + name))

    matrix = _find(table, spelled(MATRIX), path, (3, 3))
    if matrix is None:
        return None
    return _checked(matrix, _find(table, spelled(DISTORTION), path, (-1,)), offset, path)


def _checked(matrix: NDArray, distortion: NDArray | None, offset: float, path: Path) -> Intrinsics:
    distortion = np.zeros(0) if distortion is None else distortion
    plausible = np.isfinite(matrix).all() and np.isfinite(distortion).all() and np.abs(matrix).max() < MOST_PX
    if not (plausible and matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.allclose(matrix[2], (0, 0, 1))):
        raise input_error(path, "a camera matrix (fx 0 cx; 0 fy cy; 0 0 1)", str(matrix.tolist()), "Correct it.")
    if len(distortion) not in (0, 1, 2, 3, 4, 5, 8, 12, 14):
        raise input_error(path, "4, 5, 8, 12 or 14 distortion coefficients", str(len(distortion)), "Correct them.")
    if len(distortion) < 4:
        distortion = np.pad(distortion, (0, 4 - len(distortion)))
    moved = matrix.copy()
    moved[:2, 2] += offset
    return Intrinsics(moved, distortion)


def _plain_pinhole(table: Table, offset: float, path: Path) -> Intrinsics | None:
    """A camera from fx, fy, cx, cy, as in `sequence.json`, and its distortion."""
    if not {"fx", "cx", "cy"} <= table.keys():
        return None
    fx, cx, cy = (_number(table, name, path) for name in ("fx", "cx", "cy"))
    matrix = np.array([[fx, 0, cx], [0, _number(table, "fy", path, fx), cy], [0, 0, 1]])
    return _checked(matrix, _find(table, DISTORTION, path, (-1,)), offset, path)


def _da_vinci_camera(table: Table, side: str, offset: float, path: Path) -> Intrinsics:
    names = [name + side for name in ("fcx", "fcy", "ccx", "ccy")]
    if missing := [name for name in names if name not in table]:
        raise input_error(path, "fc_x, fc_y, cc_x, cc_y of both cameras", f"no {missing[0]}", "Complete it.")
    fx, fy, cx, cy = (_number(table, name, path) for name in names)
    distortion = [_number(table, f"kc{i}{side}", path, 0.0) for i in range(8)]
    if side == "right":
        for name, count in (("r", 9), ("t", 3)):
            values = [table.get(f"{name}{i}right") for i in range(count)]
            if None not in values:
                table[name] = values
    return _checked(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(distortion), offset, path)


def _number(table: Table, name: str, path: Path, otherwise: float | None = None) -> float:
    """A finite number from the table."""
    value = table.get(name, otherwise)
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise input_error(path, f"{name} to be a number", repr(value)[:60], "Correct it.")
    return number


def _size(table: Table, path: Path) -> tuple[int, int] | None:
    pairs = [("width", "height"), ("imagewidth", "imageheight"), ("resxleft", "resyleft")]
    found = [(table[a], table[b]) for a, b in pairs if a in table and b in table]
    found += [tuple(np.ravel(table[n])) for n in ("imagesize", "resolution", "size") if np.size(table.get(n, 0)) == 2]
    if not found:
        return None
    try:
        width, height = (int(v) for v in found[0])
    except (TypeError, ValueError, OverflowError):
        raise input_error(path, "width and height in px", repr(found[0])[:60], "Correct them.") from None
    if not (1 <= width < MOST_PX and 1 <= height < MOST_PX):
        raise input_error(path, "width and height in px", f"{width}x{height}", "Correct them.")
    return width, height
