"""One score of all frames together: squared errors are added up over frames before anything else is computed.

`T` frames, `H, W` image size. The mean of the scores of single frames is another number: `frames.mean_over_frames`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape


@dataclass(frozen=True)
class SquaredErrors:
    """The squared color errors of one frame."""

    total: float
    """Sum over the tissue pixels and the three channels; colors in [0, 1]."""
    of_tissue: int
    """Number of values in the sum: 3 for each tissue pixel."""
    of_frame: int
    """Number of values of the whole frame: 3 for each pixel."""


def squared_errors(image: NDArray, target: NDArray, mask: NDArray[np.bool_]) -> SquaredErrors:
    """What a frame adds to `pooled_psnr`.

    Args:
        image: (H, W, 3) rendered color in [0, 1].
        target: (H, W, 3) true color in [0, 1].
        mask: (H, W) True = tissue.
    Raises:
        ValueError: shapes differ, the mask is not bool, or an image is not finite floating point on tissue.
    """
    check_shape("image:H,W,3 target:H,W,3 mask:H,W", image=image, target=target, mask=mask)
    if mask.dtype != np.bool_:
        raise ValueError(f"mask must be bool, True = tissue; got {mask.dtype}")
    if not all(np.issubdtype(values.dtype, np.floating) for values in (image, target)):
        raise ValueError(f"image and target must be floating point; got {image.dtype} and {target.dtype}")
    total = float(np.sum((image[mask].astype(np.float64) - target[mask].astype(np.float64)) ** 2))
    if not np.isfinite(total):
        raise ValueError("image and target must be finite on tissue; got values that are not")
    return SquaredErrors(total, 3 * int(mask.sum()), image.size)


def pooled_psnr(frames: Sequence[SquaredErrors], *, over_frame: bool) -> float:
    """PSNR of all frames together, dB: -10 log10 of the sum of squared errors by the number of values.

    Args:
        frames: (T,) from `squared_errors`.
        over_frame: divide by the values of the whole frames, those outside of the mask counted as correct. It is the
            larger one by -10 log10 of the share of tissue.
    Returns:
        dB; infinity for equal images, NaN where no frame has tissue.
    """
    total = sum(frame.total for frame in frames)
    if not sum(frame.of_tissue for frame in frames):
        return float("nan")
    count = sum(frame.of_frame if over_frame else frame.of_tissue for frame in frames)
    return float(-10 * np.log10(total / count)) if total > 0 else float("inf")


def pooled_rmse(totals: Sequence[float], counts: Sequence[int]) -> float:
    """Root mean square error of all frames together, in the unit of the errors.

    Args:
        totals: (T,) sum of squared errors of each frame.
        counts: (T,) number of errors of each frame.
    Returns:
        NaN where no frame has any.
    """
    return float(np.sqrt(sum(totals) / sum(counts))) if sum(counts) else float("nan")
