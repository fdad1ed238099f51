"""Stability of the rendered depth from frame to frame. NumPy only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape


def depth_instability(
    depth_a: NDArray, depth_b: NDArray, mask_a: NDArray[np.bool_], mask_b: NDArray[np.bool_]
) -> float:
    """Mean absolute change of depth between two adjacent frames, mm: the paper's depth temporal instability.

    A pixel counts where both frames show tissue and both rendered depths are positive. True motion counts too, so
    compare methods on one sequence only. The score of a sequence is the mean over adjacent pairs.

    Args:
        depth_a: (H, W) rendered z of one frame, mm; 0 where nothing is rendered.
        depth_b: (H, W) rendered z of the next frame, mm.
        mask_a: (H, W) True = tissue in the first frame.
        mask_b: (H, W) True = tissue in the second frame.
    Returns:
        mm; NaN where no pixel counts.
    Raises:
        ValueError: shapes differ, a mask is not bool, or a depth under both masks is not finite.
    """
    check_shape(
        "depth_a:H,W depth_b:H,W mask_a:H,W mask_b:H,W", depth_a=depth_a, depth_b=depth_b, mask_a=mask_a, mask_b=mask_b
    )
    if mask_a.dtype != np.bool_ or mask_b.dtype != np.bool_:
        raise ValueError(f"mask_a and mask_b must be bool, True = tissue; got {mask_a.dtype} and {mask_b.dtype}")
    tissue = mask_a & mask_b
    a, b = depth_a[tissue].astype(np.float64), depth_b[tissue].astype(np.float64)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("depth_a and depth_b must be finite under both masks; got NaN or infinity")
    rendered = (a > 0) & (b > 0)
    return float(np.abs(b - a)[rendered].mean()) if rendered.any() else float("nan")
