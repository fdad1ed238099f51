"""Scale relative depth of a network to millimeters, with one scale and shift per clip. `H, W` image size.

Monocular networks predict depth up to an unknown scale, and inverse depth ("disparity") up to an unknown scale and
shift. Both are set once per clip from sample frames, so that the scaling adds no flicker.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_range, check_shape, input_error

Kind = Literal["depth", "disparity"]
"""Meaning of the values: in `depth` near is small, in `disparity` near is large."""

NEAR_PERCENT = 98.0
"""Percentile of disparity that represents the nearest tissue ..."""
NEAR_RATIO = 1.5
"""... assumed this many times nearer than the median. A disparity with unknown shift does not determine it."""
MAX_RATIO = 4.0
"""Depth is clipped to this ratio of the working distance."""


@dataclass(frozen=True)
class Reference:
    """How relative values of one clip map to mm."""

    middle: float
    """Median over the samples; maps to the working distance."""
    near: float
    """Percentile `NEAR_PERCENT` over the samples; used for disparity."""
    working_distance_mm: float
    """mm."""


def fit_reference(
    samples: Sequence[NDArray[np.floating]],
    usable: Sequence[NDArray[np.bool_]],
    kind: Kind,
    working_distance_mm: float = 70.0,
) -> Reference:
    """Fit the mapping to a few frames spread over the clip.

    Args:
        samples: (H, W) each, relative depth or disparity; values that are not finite, and depth <= 0, are ignored.
        usable: (H, W) each, True on tissue.
        kind: meaning of the samples.
        working_distance_mm: median depth to scale to, mm.
    Raises:
        ValueError: different numbers of samples and masks, or different sizes.
        InputError: no usable value, or constant disparity.
    """
    check_range("working_distance_mm", working_distance_mm, 1, 1000)
    kept = []
    for sample, mask in zip(samples, usable, strict=True):
        check_shape("sample:H,W usable:H,W", sample=sample, usable=mask)
        kept.append(sample[mask & _is_valid(sample, kind)])
    values = np.concatenate([*kept, np.empty(0, np.float32)])
    if not values.size:
        raise input_error(f"relative {kind}", "values on tissue", "none", "Check the masks and the depth files.")
    middle, near = (float(v) for v in np.percentile(values.astype(np.float64), [50, NEAR_PERCENT]))
    if kind == "disparity" and not near > middle:
        got = f"{middle:g} almost everywhere"
        raise input_error("relative disparity", "values that vary", got, "Check the depth files.")
    return Reference(middle, near, float(working_distance_mm))


def relative_to_mm(relative: NDArray[np.floating], kind: Kind, reference: Reference) -> NDArray[np.float32]:
    """Depth in mm: proportional to relative depth, or 1 / z linear in disparity.

    Args:
        relative: (H, W) values of one frame.
        kind: meaning of the values.
        reference: from `fit_reference` with the same kind.
    Returns:
        (H, W) depth, mm, within a factor of `MAX_RATIO` of the working distance; 0 where `relative` is invalid.
    """
    valid = _is_valid(relative, kind)
    value = np.where(valid, relative, reference.middle).astype(np.float64)
    if kind == "depth":
        ratio = value / reference.middle
    else:
        share = (value - reference.middle) / (reference.near - reference.middle)
        ratio = 1 / np.maximum(1 + share * (NEAR_RATIO - 1), 1 / MAX_RATIO)
    depth = reference.working_distance_mm * np.clip(ratio, 1 / MAX_RATIO, MAX_RATIO)
    return np.where(valid, depth, 0).astype(np.float32)


def _is_valid(relative: NDArray[np.floating], kind: Kind) -> NDArray[np.bool_]:
    """(H, W) True where a value is finite, and positive if it is a depth."""
    return np.isfinite(relative) & ((relative > 0) | (kind == "disparity"))
