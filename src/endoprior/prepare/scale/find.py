"""Find the scale of frames with relative depth, as `--known-length` and `--shaft-mm` say."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ...core.checks import input_error
from ...core.ranges import evenly_spaced
from ...data.known_length import parse_known_length, scale_by_lengths
from ...data.scale import Scale, demand_plausible
from ...footage.border import find_outline, masked_border
from ..camera_path.tracks import PoseInput
from .shaft import frontier, tip_readings

SHAFT_OPTION = "--shaft-mm"
SAMPLES = 16  # number of frames in which the border of the view is looked for
LEAST_MM, MOST_MM = 1.0, 20.0
"""Range of diameters of shafts."""
KNOW_OTHERWISE = "give a length that you know: `--known-length FRAME,X1,Y1,X2,Y2,MM`."
Frame = Callable[[int], PoseInput]


def check_scale_options(known_length: Sequence[str], shaft_mm: float) -> None:
    """Raise InputError for values of the options that cannot be, or both of them."""
    for text in known_length:
        parse_known_length(text)
    if shaft_mm and not LEAST_MM <= shaft_mm <= MOST_MM:
        fix = f"`{SHAFT_OPTION} 8` for most robotic instruments, `{SHAFT_OPTION} 5` for most others."
        raise input_error(SHAFT_OPTION, f"a diameter of {LEAST_MM:g} to {MOST_MM:g} mm", f"{shaft_mm:g}", fix)
    if known_length and shaft_mm:
        fix = f"remove {SHAFT_OPTION}: a known length is the surer one."
        raise input_error("--known-length", f"no {SHAFT_OPTION}", f"{SHAFT_OPTION} {shaft_mm:g}", fix)


def find_scale(
    frame: Frame, count: int, matrix: NDArray[np.float64], known_length: Sequence[str], shaft_mm: float
) -> Scale:
    """The scale that one of the options gives.

    Args:
        frame: reads frame i of `count`, with relative depth.
        matrix: (3, 3) K, px, with the left-most pixel centered at 0.5.
        known_length: texts `FRAME,X1,Y1,X2,Y2,MM`.
        shaft_mm: diameter of the shafts, mm; 0: not given.
    Raises:
        InputError: what an option names is not there.
    """
    check_scale_options(known_length, shaft_mm)
    if known_length:

        def read(index: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
            seen = frame(index)
            return seen.depth, ~seen.tissue_mask

        return scale_by_lengths([parse_known_length(text) for text in known_length], read, count, matrix)
    return scale_by_shafts(frame, count, matrix, shaft_mm)


def scale_by_shafts(frame: Frame, count: int, matrix: NDArray[np.float64], shaft_mm: float) -> Scale:
    """The scale at which the tips of instruments touch tissue where they do, of shafts with this diameter, mm.

    Raises:
        InputError: no tool in the masks, or no shaft that is straight and long enough.
    """
    samples = [frame(i) for i in evenly_spaced(count, SAMPLES)]
    images = [seen.rgb_u8 for seen in samples]
    outside = masked_border(find_outline(images), images, (seen.tissue_mask for seen in samples))
    readings, with_tools = [], 0
    for i in range(count):
        seen = frame(i)
        tools = ~seen.tissue_mask & ~outside
        with_tools += bool(tools.any())
        readings += tip_readings(i, tools, outside, seen.rgb_u8, seen.depth, matrix, shaft_mm / 2)
    if not with_tools:
        raise input_error(SHAFT_OPTION, "tools in the masks", f"none in {count} frames", KNOW_OTHERWISE)
    if not readings:
        want, got = "frames with a straight shaft from the border to a tip on tissue", f"none of {count}"
        raise input_error(SHAFT_OPTION, want, got, KNOW_OTHERWISE)
    log_scale, error = frontier(readings, images[0].shape[1])
    factor = float(np.exp(log_scale))
    demand_plausible(SHAFT_OPTION, factor)
    seen_in = len({reading.frame for reading in readings})
    return Scale(factor, error, f"shaft of {shaft_mm:g} mm in {seen_in} frame{'s' if seen_in > 1 else ''}")
