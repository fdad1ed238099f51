"""What `sequence.json` and `prepare.json` say of a sequence folder, checked. Every key of the first is optional.

The second is how `prepare` made the folder. It names files of the user; `check` repeats what is particular about the
video, and points of a video find their frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..core.config_io import from_dict
from ..core.shell import Options, command
from ..system.atomic import write_json
from .reading import read_json

MIN_NUMBER, MAX_NUMBER = 1e-6, 1e6  # range of every number in the file
TOOLS_FOUND = "tools found"
"""Part of the source of masks that a program found: "tools found in 70% of the samples", "no tools found"."""
OWN_POSES, COLMAP_POSES = "our own tracks", "COLMAP"
MOTION = "camera motion"  # of `sources`: how the camera moves, or `unknown`
ESTIMATED_POSES = (OWN_POSES, COLMAP_POSES)  # sources of poses that a program found in the video
SIZE_NOT_STATED = "calibration, the size of its images not stated"
"""Source of a lens whose calibration file has no image size: the principal point decided."""
FORMAT_VERSION = 1  # newest `format_version` this program can read; a file without one is of version 1
CORRECT = "correct it or remove it."


def is_number(value: Any) -> bool:
    """Whether a value of a JSON file is a number that can be used."""
    return not isinstance(value, bool) and isinstance(value, int | float) and MIN_NUMBER <= value <= MAX_NUMBER


def _is_share(value: Any, most: float) -> bool:
    return not isinstance(value, bool) and isinstance(value, int | float) and 0 <= value <= most


def _is_all(value: Any, kind: type, of: type) -> bool:
    """Whether a value is a list or a dict, and all in it are of one type; a bool is no int."""
    return type(value) is kind and all(type(each) is of for each in (value.values() if kind is dict else value))


NUMBERS = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale", "frames_per_second")
KEYS: dict[str, tuple[str, Callable[[Any], bool], str]] = {
    **dict.fromkeys(NUMBERS, (f"to be a number in [{MIN_NUMBER:g}, {MAX_NUMBER:g}]", is_number, CORRECT)),
    "depth_unit": ("mm", lambda unit: unit == "mm", "give mm, and mm per stored unit as depth_scale."),
    "mask_tool_value": ("255 or 0", lambda value: value in (0, 255), "give the one that marks tools."),
    "depth_relative": ("true or false", lambda value: isinstance(value, bool), CORRECT),
    "scale_factor": (f"to be a number in [{MIN_NUMBER:g}, {MAX_NUMBER:g}]", is_number, CORRECT),
    "scale_error": ("to be a number in [0, 10]", lambda value: _is_share(value, 10), CORRECT),
    "scale_source": ("to be a text", lambda value: isinstance(value, str) and 0 < len(value) <= 300, CORRECT),
    "sources": ("to map names to texts", lambda value: _is_all(value, dict, str), CORRECT),
    "unexplained_frames": ("to be a list of frame numbers", lambda value: _is_all(value, list, int), CORRECT),
    "frame_weights": (
        "to be a list of one number in [0, 1] for each frame",
        lambda value: type(value) is list and all(type(each) in (int, float) and 0 <= each <= 1 for each in value),
        CORRECT,
    ),
    "format_version": (
        f"1 to {FORMAT_VERSION}",
        lambda value: type(value) is int and 1 <= value <= FORMAT_VERSION,
        "update endoprior, or prepare the folder again.",
    ),
}
"""What is expected of each key, whether a value is that, and the fix."""
RECORD = "prepare.json"
PATH_RECORD = "camera_path.json"  # in a sequence folder: how each pose was found, and how sure it is
SCALED = ("scale_factor", "scale_error", "scale_source")
"""Keys of a sequence whose relative depth was brought to mm (`data.scale`): all, or none."""
SCALE_PENDING = "scale_pending"  # folder of what is being moved to its place when relative depth gets a scale
STEPS, NEAR_PX = 40, 0.5  # to find a source point in the frame, and how near they end, px, unless it lies outside


def read_description(path: Path) -> dict[str, Any]:
    """The checked contents of `sequence.json`, or an empty dict when there is none. Unknown keys are kept."""
    if (path.parent / SCALE_PENDING).is_dir():
        fix = f"finish it: `{command('scale', path.parent)}`."
        raise input_error(path.parent, "a complete folder", "one whose change of scale was interrupted", fix)
    if not path.exists():
        return {}
    described = {key: value for key, value in read_json(path).items() if value is not None}
    for key, (want, is_right, hint) in KEYS.items():
        if key in described and not is_right(described[key]):
            raise input_error(path, f"{key} {want}", repr(described[key])[:60], hint)
    return described


def frame_weights(path: Path, described: dict[str, Any], count: int) -> NDArray[np.float64]:
    """(T,) how far each frame is to be believed, in [0, 1]: 0 for `unexplained_frames`, else `frame_weights`, or 1.

    Raises:
        InputError: the sequence does not have one of the unexplained frames, or the weights are not one for each frame.
    """
    marked = described.get("unexplained_frames", [])
    if outside := [index for index in marked if not 0 <= index < count]:
        raise input_error(path, f"unexplained_frames in 0..{count - 1}", str(outside[0]), CORRECT)
    weights = np.array(described.get("frame_weights", np.ones(count)), np.float64)
    if len(weights) != count:
        raise input_error(path, f"frame_weights of {count} frames", str(len(weights)), CORRECT)
    weights[marked] = 0
    return weights


def intrinsics_of(
    path: Path, described: dict[str, Any], width: int, height: int, focal: float
) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy), px: those described, else `focal` and the image center."""
    if {"width", "height"} <= described.keys() and (described["width"], described["height"]) != (width, height):
        got = f"{described['width']}x{described['height']}"
        hint = "scale fx, fy, cx, cy to the images, or remove the file."
        raise input_error(path, f"the images' size {width}x{height}", got, hint)
    fx = float(described.get("fx", focal))
    fy = float(described.get("fy", fx))
    return fx, fy, float(described.get("cx", width / 2)), float(described.get("cy", height / 2))


@dataclass(frozen=True)
class PrepareRecord:
    """How a folder was prepared."""

    video: str  # absolute path of the source
    options: Options  # all options that differ from their defaults; paths are absolute
    source_size: tuple[int, int]
    """(width, height) of one camera's image in the source, px: what `--crop` and `--blank` count."""
    source_px: tuple[tuple[tuple[float, ...], ...], ...]
    """(R, C, 2) x, y in that image, px, of an even grid over the frame, from corner to corner; R, C at least 2."""
    video_notes: tuple[str, ...] = ()
    """What is particular about the video, and which of its images were not used, one line each."""

    def save(self, folder: Path) -> None:
        """Write `prepare.json`."""
        write_json(folder / RECORD, asdict(self))

    def in_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where points of the source lie in the frame: through the rectification, or undistortion, and the crop.

        Args:
            points: (P, 2) x, y in the source, px.
        Returns:
            (P, 2) x, y as shares of the frame's width and height; NaN for points that the frame does not show.
        """
        from scipy.interpolate import RectBivariateSpline  # slow to import, and every reader imports this module

        grid = np.array(self.source_px)
        rows, columns = (np.linspace(0, 1, count) for count in grid.shape[:2])
        order = {"kx": min(3, len(rows) - 1), "ky": min(3, len(columns) - 1)}
        splines = [RectBivariateSpline(rows, columns, grid[..., axis], **order) for axis in (0, 1)]

        def missed(at: NDArray[np.float64]) -> NDArray[np.float64]:
            """(P, 2) from where shares of the frame lie in the source to the points, px."""
            return points - np.stack([spline.ev(at[:, 1], at[:, 0]) for spline in splines], 1)

        at, extent = np.full(points.shape, 0.5), grid[-1, -1] - grid[0, 0]
        for _ in range(STEPS):  # the map is nearly a scaling and a shift
            at = np.clip(at + missed(at) / extent, 0, 1)
        off = np.linalg.norm(missed(at), axis=1)
        return np.where(off[:, None] < NEAR_PX, at, np.nan)


def read_record(folder: Path) -> PrepareRecord | None:
    """The record of a folder; None if it has none."""
    file, fix = folder / RECORD, "remove it, or prepare the folder again."
    if not file.exists():
        return None
    try:
        record = from_dict(PrepareRecord, read_json(file, fix), "record")
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    widths = {len(row) for row in record.source_px}
    pairs = all(len(point) == 2 for row in record.source_px for point in row)
    if not pairs or len(widths) != 1 or min(len(record.source_px), *widths) < 2 or min(record.source_size) < 1:
        raise input_error(file, "source_px as rows of x, y", "another shape", fix)
    return record
