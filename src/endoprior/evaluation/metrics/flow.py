"""Flow error: does the rendered video move as the true one does? The paper's temporal score.

The optical flow between two true frames is compared with the flow between the two rendered ones. The estimator is part
of the score's name: `flow_error` (RAFT-large, as published), `flow_error_raft_small`, `flow_error_dis`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.checks import check_shape
from .weights import ScoreUnavailable

DIS_MIN_SIZE = 32
"""Shortest image side for DIS, px: a shorter one has no room for two levels of its 8 px patches."""


FlowEstimator = Callable[[NDArray[np.uint8], NDArray[np.uint8]], NDArray[np.float32]]
"""Gives the (H, W, 2) displacement (x, y) in px from the first to the second of two (H, W, 3) 8-bit RGB images."""


def dis_flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Dense inverse search (Kroeger et al. 2016) by OpenCV, medium preset, on gray images; see `FlowEstimator`.

    The result is bit-identical for any number of OpenCV threads.

    Raises:
        ScoreUnavailable: a side is shorter than `DIS_MIN_SIZE`.
    """
    if min(first.shape[:2]) < DIS_MIN_SIZE:
        height, width = first.shape[:2]
        raise ScoreUnavailable(f"DIS flow needs images of at least {DIS_MIN_SIZE} px a side; got {width}x{height}")
    gray_first, gray_second = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (first, second))
    # A new estimator for each pair: its buffers would make a pair depend on the one before.
    estimator = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return estimator.calc(gray_first, gray_second, None)


def flow_error(
    renders: Sequence[NDArray[np.uint8]],
    targets: Sequence[NDArray[np.uint8]],
    masks: Sequence[NDArray[np.bool_]],
    estimator: FlowEstimator,
) -> NDArray[np.float64]:
    """Mean end-point distance between rendered and true flow, for each pair of consecutive images of the lists.

    Consecutive in the lists: over a test split these are frames 8 apart in the video, as published. All images
    are multiplied by their tissue mask first, and a pixel counts where both frames of the pair show tissue.

    Args:
        renders: T rendered images, (H, W, 3) 8-bit RGB.
        targets: T true images, (H, W, 3) 8-bit RGB.
        masks: T tissue masks, (H, W) True = tissue.
        estimator: called twice a pair.
    Returns:
        (T - 1,) px; NaN for a pair whose masks share no pixel. The score is the mean over pairs.
    Raises:
        ValueError: the lists differ in length, shapes differ, images are not uint8, or masks are not bool.
        ScoreUnavailable: the estimator cannot work on images of this size.
    """
    if not len(renders) == len(targets) == len(masks):
        raise ValueError(
            f"renders, targets and masks must have one length; got {len(renders)}, {len(targets)}, {len(masks)}"
        )
    masked = [_masked(*triple) for triple in zip(renders, targets, masks, strict=True)]
    errors = np.full(max(len(masked) - 1, 0), np.nan)
    for k in range(len(errors)):
        (render_a, target_a), (render_b, target_b) = masked[k], masked[k + 1]
        check_shape("first:H,W,3 second:H,W,3", first=target_a, second=target_b)
        both = masks[k] & masks[k + 1]
        if both.any():
            difference = estimator(render_a, render_b) - estimator(target_a, target_b)
            errors[k] = np.linalg.norm(difference[both].astype(np.float64), axis=-1).mean()
    return errors


def _masked(
    render: NDArray[np.uint8], target: NDArray[np.uint8], mask: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Render and target with everything but tissue black, after checking their shapes and types."""
    check_shape("render:H,W,3 target:H,W,3 mask:H,W", render=render, target=target, mask=mask)
    if render.dtype != np.uint8 or target.dtype != np.uint8 or mask.dtype != np.bool_:
        raise ValueError(
            f"renders and targets must be uint8 and masks bool; got {render.dtype}, {target.dtype}, {mask.dtype}"
        )
    return render * mask[..., None], target * mask[..., None]
