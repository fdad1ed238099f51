"""Lens distortion in a calibration: which model its file names, and its coefficients in OpenCV's order.

Two models are used: OpenCV's usual one (Brown-Conrady, radial and tangential), and its fisheye model (equidistant,
Kannala-Brandt). Four numbers mean different things in each, so a model that is named and not known is an error.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .calibration_tables import plain

VECTORS = (
    "d", "dist", "distortion", "distcoeffs", "distcoeff", "distcoef", "distortioncoefficients", "distortioncoeffs",
    "distortioncoeff", "distortionparameters", "distortionparams", "distortionvector", "distcoefficients", "kc",
)  # fmt: skip
"""Names of all coefficients together."""
RADIAL, TANGENTIAL = ("radialdistortion", "radial"), ("tangentialdistortion", "tangential")
"""MATLAB's names of the two parts."""
BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Names of single coefficients, in OpenCV's order."""
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
    if not np.isfinite(found).all():
        raise input_error(path, "the distortion to be finite", "NaN or infinity", "Calibrate again.")
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
    named = [(name, str(local[name])) for name in (*MODEL_NAMES, *LENS_NAMES) if isinstance(local.get(name), str)]
    fisheye = any(_flag(local.get(name)) for name in FLAGS)
    for name, words in named:
        model = plain(words)
        if any(model == other or (len(other) > 4 and other in model) for other in OTHERS) or "xi" in local:
            _reject(words, path)
        if any(model == each or (len(each) > 4 and each in model) for each in FISHEYES):
            fisheye = True
        elif model not in USUAL and name in MODEL_NAMES:
            _reject(words, path)
    return fisheye


def _flag(value: Any) -> bool:
    return value is True or plain(str(value)) in ("1", "10", "true", "yes")


def _reject(model: str, path: Path) -> None:
    want = "a lens of OpenCV's usual model (plumb_bob, radtan, rational_polynomial) or a fisheye (equidistant)"
    raise input_error(path, want, model[:60], "Undistort the video first, or calibrate with one of these.")


def _coefficients(local: Mapping[str, Any], fisheye: bool, path: Path) -> NDArray[np.float64] | None:
    """What the file has, in one vector; None without any."""
    for name in VECTORS:
        if name in local and not isinstance(local[name], str) and local[name] is not None:
            return _numbers(local[name], name, path)
    radial = next((_numbers(local[name], name, path) for name in RADIAL if name in local), None)
    if radial is not None:
        bent = next((_numbers(local[name], name, path) for name in TANGENTIAL if name in local), np.zeros(2))
        return np.concatenate([np.pad(radial, (0, 3))[:2], bent[:2], radial[2:3]])
    singles = {name: _numbers(local[name], name, path)[0] for name in BROWN if _is_single(local.get(name))}
    if not singles:
        return None
    if fisheye:
        return np.array([singles.get(name, 0.0) for name in FISHEYE])
    if "k4" in singles and not {"p1", "k5", "k6"} & singles.keys():
        hint = "Add `distortion_model: equidistant` for a fisheye, or k5 and k6."
        raise input_error(path, "the model of the distortion beside k1 k2 k3 k4", "none", hint)
    return np.array([singles.get(name, 0.0) for name in BROWN[: 8 if {"k4", "k5", "k6"} & singles.keys() else 5]])


def _is_single(value: Any) -> bool:
    return value is not None and np.ndim(value) == 0


def _numbers(value: Any, name: str, path: Path) -> NDArray[np.float64]:
    try:
        return np.asarray(value, np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise input_error(path, f"{name} to be a number or numbers", repr(value)[:60], "Correct it.") from None


def _holds_numbers(value: Any) -> bool:
    try:
        return bool(np.any(np.asarray(value, np.float64)))
    except (TypeError, ValueError, OverflowError):
        return False
