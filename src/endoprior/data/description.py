"""`sequence.json`: the description of a sequence folder, checked. Every key is optional."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core.checks import input_error
from .files import read_json

LEAST, MOST = 1e-6, 1e6
"""Range of every number in the file."""
TOOLS_FOUND = "tools found"
"""Part of the source of masks that a program found: "tools found in 70% of the samples", "no tools found"."""
OWN_POSES, COLMAP_POSES = "our own tracks", "COLMAP"
ESTIMATED_POSES = (OWN_POSES, COLMAP_POSES)
"""Sources of poses that a program found in the video."""
SIZE_NOT_STATED = "calibration, the size of its images not stated"
"""Source of a lens whose calibration file has no image size: the principal point decided."""
FORMAT_VERSION = 1
"""Newest `format_version` this program can read; a file without one is of version 1."""
POSITIVE = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale", "frames_per_second")


def read_description(path: Path) -> dict[str, Any]:
    """The checked contents of `sequence.json`, or an empty dict when there is none. Unknown keys are kept.

    Raises:
        InputError: not a JSON object, or a known key has an invalid value.
    """
    if not path.exists():
        return {}
    described = {key: value for key, value in read_json(path).items() if value is not None}
    for key in POSITIVE:
        value = described.get(key, 1)
        if isinstance(value, bool) or not isinstance(value, int | float) or not LEAST <= value <= MOST:
            want = f"{key} to be a number in [{LEAST:g}, {MOST:g}]"
            raise input_error(path, want, repr(value)[:60], "correct it or remove it.")
    if described.get("depth_unit", "mm") != "mm":
        hint = "give mm, and mm per stored unit as depth_scale."
        raise input_error(path, "depth_unit mm", repr(described["depth_unit"]), hint)
    if described.get("mask_tool_value", 255) not in (0, 255):
        hint = "give the one that marks tools."
        raise input_error(path, "mask_tool_value 255 or 0", repr(described["mask_tool_value"]), hint)
    _check_origins(path, described)
    return described


def check_frames(path: Path, described: dict[str, Any], count: int) -> list[str]:
    """A remark if there are `unexplained_frames`; raises InputError if the sequence does not have one of them."""
    marked = described.get("unexplained_frames", [])
    outside = [index for index in marked if not 0 <= index < count]
    if outside:
        raise input_error(path, f"unexplained_frames in 0..{count - 1}", str(outside[0]), "correct it or remove it.")
    if not marked:
        return []
    return [f"{path}: {len(marked)} frames are marked as unexplained, the first is frame {min(marked)}"]


def intrinsics_of(
    path: Path, described: dict[str, Any], width: int, height: int, focal: float
) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy), px: those described, else `focal` and the image center.

    Raises:
        InputError: the description is for images of another size.
    """
    if {"width", "height"} <= described.keys() and (described["width"], described["height"]) != (width, height):
        got = f"{described['width']}x{described['height']}"
        hint = "scale fx, fy, cx, cy to the images, or remove the file."
        raise input_error(path, f"the images' size {width}x{height}", got, hint)
    fx = float(described.get("fx", focal))
    fy = float(described.get("fy", fx))
    return fx, fy, float(described.get("cx", width / 2)), float(described.get("cy", height / 2))


def _check_origins(path: Path, described: dict[str, Any]) -> None:
    """Raise InputError for wrong values of the keys that describe how a sequence was made."""
    hint = "correct it or remove it."
    relative = described.get("depth_relative", False)
    if not isinstance(relative, bool):
        raise input_error(path, "depth_relative true or false", repr(relative), hint)
    sources = described.get("sources", {})
    if not isinstance(sources, dict) or not all(isinstance(value, str) for value in sources.values()):
        raise input_error(path, "sources to map names to texts", repr(sources), hint)
    frames = described.get("unexplained_frames", [])
    if not isinstance(frames, list) or not all(type(index) is int for index in frames):
        raise input_error(path, "unexplained_frames to be a list of frame numbers", repr(frames), hint)
    version = described.get("format_version", FORMAT_VERSION)
    if type(version) is not int or not 1 <= version <= FORMAT_VERSION:
        hint = "update endoprior, or prepare the folder again."
        raise input_error(path, f"format_version 1 to {FORMAT_VERSION}", repr(version), hint)
