"""Corners followed from one training frame to the next: they tell whether refined poses still explain the video.

No loss uses them. Tissue that moves adds to the error of every pose alike, and the median leaves most of it out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.geometry import back_project, project
from ..core.types import Camera
from ..footage.corner_flow import follow_both_ways
from .frames import TrainingFrames

CORNERS = 120
"""Corners in each frame."""
RETURN_PX = 0.7
"""Largest distance between a corner and where the flow back from its end leads."""


@dataclass(frozen=True)
class FollowedCorners:
    """Corners of a training frame with depth, and where the next training frame shows them."""

    first: int
    """Position of the frame among the training frames."""
    pixels: NDArray[np.float64]
    """(P, 2)."""
    depth_mm: NDArray[np.float64]
    """(P,)."""
    there: NDArray[np.float64]
    """(P, 2) in the next one."""


def follow_corners(frames: TrainingFrames) -> list[FollowedCorners]:
    """Corners of every training frame but the last, followed to the next by Lucas and Kanade's flow and back."""
    found, before = [], None
    for position in range(len(frames)):
        frame = frames.frame(position)
        gray = cv2.cvtColor(frame.rgb_u8.cpu().numpy(), cv2.COLOR_RGB2GRAY)
        inverse, measured = frame.inverse_depth.cpu().numpy(), frame.measured.cpu().numpy()
        if before is not None and (corners := _followed(position - 1, before, gray)):
            found.append(corners)
        before = gray, inverse, measured
    return found


def _followed(
    first: int, before: tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]], gray: NDArray[np.uint8]
) -> FollowedCorners | None:
    """None where no corner can be followed."""
    was, inverse, measured = before
    inner = cv2.erode(measured.astype(np.uint8), np.ones((7, 7), np.uint8))
    corners = cv2.goodFeaturesToTrack(was, CORNERS, 0.01, 9, mask=inner)
    if corners is None:
        return None
    corners = corners[:, 0]
    there, kept = follow_both_ways(was, gray, corners, RETURN_PX)
    if not kept.any():
        return None
    x, y = corners[kept].round().astype(int).T
    # OpenCV counts pixel centers from 0.
    pixels, ends = (points[kept].astype(np.float64) + 0.5 for points in (corners, there))
    return FollowedCorners(first, pixels, 1 / inverse[y, x].astype(np.float64), ends)


def corner_error_px(corners: Sequence[FollowedCorners], cameras: Sequence[Camera]) -> float:
    """Median distance between where a corner is seen next and where the cameras put it, px; NaN without corners.

    Args:
        cameras: of the training frames.
    """
    distances = []
    for each in corners:
        points = back_project(each.pixels, each.depth_mm, cameras[each.first])
        pixels, _ = project(points, cameras[each.first + 1])
        distances.append(np.linalg.norm(pixels - each.there, axis=1))
    return float(np.median(np.concatenate(distances))) if distances else float("nan")
