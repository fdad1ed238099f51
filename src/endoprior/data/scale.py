"""The scale of relative depth: mm per unit, as `sequence.json` has it, and as known lengths in the images give it.

A known length is two pixels of a frame that are so many mm apart. H, W image size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape, frame_list, input_error
from ..core.geometry import project
from ..core.types import Camera
from .description import SCALED

MIN_FACTOR, MAX_FACTOR = 0.02, 50.0
"""Range of factors: relative depth has a median of 70, tissue is 1.4 mm to 3.5 m away."""
GIVE_BOTH = "correct them, or remove all three."
OPTION = "--known-length"
FORM = "FRAME,X1,Y1,X2,Y2,MM"
EXAMPLE = f"`{OPTION} 12,310,205,402,198,20`."
WINDOW_PX = 2  # depth at a point is the median of the tissue within so many px
CLICK_PX = 1.5  # standard deviation of a point's place
SHAPE_STD = 0.12
"""Standard deviation of the log of a long length in relative depth of the right scale (docs/depth_and_poses.md)."""
RELIEF_STD = 0.08
"""Relief that relative depth misses between two points: standard deviation of its ratio to their distance."""
PRIOR_WEIGHT = 2.0  # lengths that `SHAPE_STD` counts as, beside the spread of those that are given
MAX_MM = 1000.0
ROUNDS = 20
HUBER = 1.345  # residuals beyond so many standard deviations weigh less
Read = Callable[[int], tuple[NDArray[np.float32], NDArray[np.bool_]]]
"""Depth (H, W) of a frame, 0 where missing, and (H, W) True on tools and outside of the view."""


@dataclass(frozen=True)
class Scale:
    """Lengths in mm = `factor` x lengths in relative units."""

    factor: float  # > 0
    error: float  # standard deviation of log(factor): 0.07 is 7 %
    source: str  # such as `known length in frame 12`

    @property
    def text(self) -> str:
        """In one line, for a person."""
        return f"{self.source}; lengths in mm err by {self.error:.0%} (standard deviation of the scale)"

    @property
    def described(self) -> dict[str, Any]:
        """Its entries of `sequence.json`."""
        return {"scale_factor": self.factor, "scale_error": self.error, "scale_source": self.source}


def demand_plausible(option: str, factor: float) -> None:
    """Raise InputError if tissue would be at no distance of an endoscope; `option` gave the factor."""
    if not MIN_FACTOR <= factor <= MAX_FACTOR:
        want = f"a scale of {MIN_FACTOR:g} to {MAX_FACTOR:g} mm per unit of relative depth"
        raise input_error(option, want, f"{factor:.3g}", "correct the frame, the points or the length in mm.")


def described_scale(path: Path, described: dict[str, Any]) -> Scale | None:
    """The scale in the checked contents of a `sequence.json`; None if there is none.

    Raises:
        InputError: only a part of it is there, or depth is relative all the same.
    """
    there = [key for key in SCALED if key in described]
    if not there:
        return None
    if len(there) < len(SCALED):
        raise input_error(path, f"all of {', '.join(SCALED)}", f"only {', '.join(there)}", GIVE_BOTH)
    if described.get("depth_relative", False):
        raise input_error(path, "depth_relative false with scale_factor", "true", GIVE_BOTH)
    return Scale(float(described["scale_factor"]), float(described["scale_error"]), described["scale_source"])


def without_scale(described: dict[str, Any]) -> dict[str, Any]:
    """The description of a sequence whose scale is not known any more; its numbers stay as they are."""
    return {key: value for key, value in described.items() if key not in SCALED} | {"depth_relative": True}


def demand_relative(folder: Path, described: dict[str, Any]) -> None:
    """Raise InputError unless the depth of a folder is relative, or was before it got a scale."""
    if not described.get("depth_relative", False) and described_scale(folder, described) is None:
        fix = "leave the folder as it is: its lengths are in mm already."
        raise input_error(folder, "relative depth, of a video of one camera", "depth in mm", fix)


@dataclass(frozen=True)
class KnownLength:
    """Two pixels of a frame, x, y in px of the written frame, whose first pixel covers 0..1; and their distance."""

    frame: int
    first: tuple[float, float]
    second: tuple[float, float]
    mm: float

    @property
    def text(self) -> str:
        """As it is typed."""
        return ",".join(f"{value:g}" for value in (self.frame, *self.first, *self.second, self.mm))


def parse_known_length(text: str, option: str = OPTION) -> KnownLength:
    """A length from `FRAME,X1,Y1,X2,Y2,MM`; InputError for another form, or if MM is not above 0."""
    try:
        frame, *rest = text.split(",")
        x1, y1, x2, y2, mm = map(float, rest)
        found = KnownLength(int(frame), (x1, y1), (x2, y2), mm)
    except ValueError:
        raise input_error(option, FORM, repr(text), EXAMPLE) from None
    if not 0 < mm <= MAX_MM:
        raise input_error(option, f"a length above 0, up to {MAX_MM:g} mm", f"{mm:g} in {text}", EXAMPLE)
    if not np.isfinite((x1, y1, x2, y2)).all() or (x1, y1) == (x2, y2):
        raise input_error(option, "two different points", text, EXAMPLE)
    return found


def relative_length(
    length: KnownLength, depth: NDArray, tools: NDArray[np.bool_], matrix: NDArray, option: str = OPTION
) -> tuple[float, float]:
    """The distance of the two points in the units of the depth, and its relative standard deviation (`length_std`).

    |z1 K^-1 (x1, y1, 1) - z2 K^-1 (x2, y2, 1)|, with z the median depth of tissue around a point.

    Args:
        depth: (H, W), 0 where missing. tools: (H, W) True on tools and outside of the view.
        matrix: (3, 3) K, px, with the left-most pixel centered at 0.5.
    Raises:
        InputError: a point is not in the image, or without depth of tissue.
    """
    height, width = depth.shape
    points = []
    for x, y in (length.first, length.second):
        named = f"{x:g}, {y:g} in {length.text}"
        if not (0 <= x < width and 0 <= y < height):
            raise input_error(option, f"points within the frame of {width}x{height} px", named, EXAMPLE)
        rows, columns = (slice(max(int(v) - WINDOW_PX, 0), int(v) + WINDOW_PX + 1) for v in (y, x))
        if tools[int(y), int(x)]:
            fix = "choose points on tissue: a tool has no depth of its own here."
            raise input_error(option, "points on tissue", f"a masked pixel at {named}", fix)
        around = depth[rows, columns][(depth[rows, columns] > 0) & ~tools[rows, columns]]
        if not around.size:
            raise input_error(option, "points with depth", f"none at {named}", "choose other points.")
        points.append(np.median(around) * np.linalg.solve(matrix, [x, y, 1.0]))
    pixels = float(np.hypot(*np.subtract(length.first, length.second)))
    return float(np.linalg.norm(points[0] - points[1])), length_std(pixels, float(matrix[0, 0]))


def length_std(pixels: float, focal: float) -> float:
    """Standard deviation of the log of a length that is so many px long in the image. `focal` length, px.

    A length l at distance z is l f / z px long. Relief of r z that is missed makes it longer, sqrt(l^2 + (r z)^2), by
    about (r f / px)^2 / 2 of it: short lengths say little. Both points are clicked within `CLICK_PX`.
    """
    relief = (RELIEF_STD * focal / pixels) ** 2 / 2
    return float(np.sqrt(SHAPE_STD**2 + relief**2 + 2 * (CLICK_PX / pixels) ** 2))


def scale_by_lengths(
    lengths: Sequence[KnownLength], read: Read, count: int, matrix: NDArray, option: str = OPTION
) -> Scale:
    """The scale at which known lengths have their lengths.

    Of several, the robust mean (Huber) of the logs of mm / relative length, and the error that follows from their
    spread; of one, the usual error of a length in relative depth.

    Args:
        read: gives depth and masks of a frame, of the same `count` frames.
        matrix: (3, 3) K, px, with the left-most pixel centered at 0.5.
    Raises:
        InputError: a frame or a point that there is not, or a scale that cannot be.
    """
    logs, stds = [], []
    for length in lengths:
        if not 0 <= length.frame < count:
            raise input_error(option, f"a frame in 0..{count - 1}", f"{length.frame} in {length.text}", EXAMPLE)
        units, std = relative_length(length, *read(length.frame), matrix, option)
        if not units > 0:
            raise input_error(option, "points that are apart", length.text, EXAMPLE)
        logs.append(np.log(length.mm / units))
        stds.append(std)
    mean, error = robust_mean(np.array(logs), np.array(stds))
    factor = float(np.exp(mean))
    demand_plausible(option, factor)
    frames = sorted({length.frame for length in lengths})
    what = "known length" if len(lengths) == 1 else f"{len(lengths)} known lengths"
    return Scale(factor, error, f"{what} in {frame_list(frames)}")


def scale_between(
    points: NDArray[np.float64], camera: Camera, mm: float, frame: int, old: Scale | None, what: str
) -> Scale:
    """The scale at which two points are so many mm apart.

    Args:
        points: (2, 3) world axes, in the units of a sequence whose scale is `old`, seen by the camera of the frame.
        what: names the number in errors.
    Raises:
        InputError: a length of 0 or less, one point, or a scale that cannot be.
    """
    check_shape("points:2,3", points=points)
    units, factor = float(np.linalg.norm(points[0] - points[1])), old.factor if old else 1.0
    if not (0 < mm <= MAX_MM and units > 0):
        got = f"{mm:g} mm" if units > 0 else "one point"
        raise input_error(what, f"two points and a length above 0, up to {MAX_MM:g} mm", got, "enter the length.")
    pixels = float(np.linalg.norm(np.subtract(*project(points, camera)[0])))
    demand_plausible(what, mm / units * factor)
    return Scale(mm / units * factor, length_std(max(pixels, 1.0), camera.fx), f"known length in frame {frame}")


def robust_mean(values: NDArray[np.float64], stds: NDArray[np.float64]) -> tuple[float, float]:
    """Huber's mean of (N,) values, and its standard deviation, by their spread and the (N,) expected ones."""
    mean = float(np.median(values))
    weights = 1 / stds**2
    for _ in range(ROUNDS):
        off = np.abs(values - mean) / stds
        weights = np.minimum(1, HUBER / np.maximum(off, 1e-12)) / stds**2
        mean = float(weights @ values / weights.sum())
    spread = float((((values - mean) / stds) ** 2).sum())  # 1 for each value that is as far off as expected
    growth = (PRIOR_WEIGHT + spread) / (PRIOR_WEIGHT + len(values) - 1)
    return mean, float(np.sqrt(growth / (1 / stds**2).sum()))
