"""A network's relative depth in millimeters: one scale, and one shift, for a whole clip. `H, W` image size.

Networks that see one picture know depth up to an unknown scale, and inverse depth ("disparity") up to an unknown scale
and shift. Both are chosen once from samples, so that nothing moves from frame to frame but what the network says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, check_range, check_shape

Kind = Literal["depth", "disparity"]
"""What the numbers are: near is small, or near is large."""

NEAR_PERCENT = 98.0
"""Percentile of disparity that stands for the nearest tissue ..."""
NEAR_RATIO = 1.5
"""... which is assumed this much nearer than the middle: nothing in a disparity with unknown shift says so."""
MAX_RATIO = 4.0
"""Depth stays within this ratio of the working distance."""


@dataclass(frozen=True)
class Reference:
    """What relative values of one clip mean."""

    middle: float
    """Median over the samples; it becomes the working distance."""
    near: float
    """Percentile `NEAR_PERCENT` over the samples, for disparity."""
    working_distance_mm: float
    """mm."""


def fit_reference(
    samples: Sequence[NDArray[np.floating]],
    usable: Sequence[NDArray[np.bool_]],
    kind: Kind,
    working_distance_mm: float = 70.0,
) -> Reference:
    """Find what a clip's relative values mean from a few frames spread over it.

    Args:
        samples: (H, W) each, relative depth or disparity; values that are not finite do not count, nor does depth <= 0.
        usable: (H, W) each, True on tissue.
        kind: what the samples hold.
        working_distance_mm: median depth to scale to, mm.
    Raises:
        ValueError: different numbers of samples and masks, or different sizes.
        InputError: no usable value, or values that do not vary (disparity).
    """
    check_range("working_distance_mm", working_distance_mm, 1, 1000)
    kept = []
    for sample, mask in zip(samples, usable, strict=True):
        check_shape("sample:H,W usable:H,W", sample=sample, usable=mask)
        kept.append(sample[mask & _meaningful(sample, kind)])
    values = np.concatenate([*kept, np.empty(0, np.float32)])
    if not values.size:
        raise InputError(f"relative {kind}: expected values on tissue; got none. Check the masks and the files.")
    middle, near = (float(v) for v in np.percentile(values.astype(np.float64), [50, NEAR_PERCENT]))
    if kind == "disparity" and not near > middle:
        raise InputError(
            f"relative disparity: expected values that vary; got {middle:g} almost everywhere. Check the files."
        )
    return Reference(middle, near, float(working_distance_mm))


def relative_to_mm(relative: NDArray[np.floating], kind: Kind, reference: Reference) -> NDArray[np.float32]:
    """Depth in mm: proportional to relative depth, or 1 / z linear in disparity.

    Args:
        relative: (H, W) one frame.
        kind: what it holds.
        reference: from `fit_reference` with the same kind.
    Returns:
        (H, W) depth, mm, within a factor of `MAX_RATIO` of the working distance; 0 where `relative` says nothing.
    """
    said = _meaningful(relative, kind)
    value = np.where(said, relative, reference.middle).astype(np.float64)
    if kind == "depth":
        ratio = value / reference.middle
    else:
        share = (value - reference.middle) / (reference.near - reference.middle)
        ratio = 1 / np.maximum(1 + share * (NEAR_RATIO - 1), 1 / MAX_RATIO)
    depth = reference.working_distance_mm * np.clip(ratio, 1 / MAX_RATIO, MAX_RATIO)
    return np.where(said, depth, 0).astype(np.float32)


def _meaningful(relative: NDArray[np.floating], kind: Kind) -> NDArray[np.bool_]:
    """(H, W) True where a value says something: finite, and positive if it is a depth."""
    return np.isfinite(relative) & ((relative > 0) | (kind == "disparity"))
