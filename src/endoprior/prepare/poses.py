"""Estimate camera poses from depth and static tissue: track corners with known depth, solve perspective-n-point.

World axes are the camera axes of frame 0. RANSAC ignores moving tissue as long as most tissue is static.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..data.numpy_files import read_numpy
from ..data.poses import demand_rotations

MAX_CORNERS = 800
MIN_POINTS = 30
"""With fewer tracked points a frame gets no pose."""
MIN_INLIERS = 0.4
"""Share of tracked points that must be inliers; below, no rigid motion explains the frame."""
REFRESH = 0.6
"""New corners are detected when fewer than this share of MAX_CORNERS is left."""
ERROR_PX = 0.004
"""Largest reprojection error of an inlier, as a share of the image width: 2.5 px at 640."""
EDGE_STEP = 0.05
"""No corners where depth changes by more than this share between neighbors: those are depth edges."""


@dataclass(frozen=True)
class PoseInput:
    """One frame for pose estimation."""

    rgb_u8: NDArray[np.uint8]
    """(H, W, 3)."""
    tissue_mask: NDArray[np.bool_]
    """(H, W) True outside tools."""
    depth: NDArray[np.float32]
    """(H, W) mm, 0 where missing."""


@dataclass(frozen=True)
class PosePath:
    """Poses of all frames."""

    camera_to_world: NDArray[np.float64]
    """(T, 4, 4), translation in mm; an unexplained frame has the pose of the frame before it."""
    explained: NDArray[np.bool_]
    """(T,) whether enough points are inliers."""
    depth_scale: NDArray[np.float64]
    """(T,) factor that makes the depth of the frame agree with the tracked points."""


def estimate_poses(
    frame: Callable[[int], PoseInput], count: int, matrix: NDArray[np.float64], *, relative_depth: bool
) -> PosePath:
    """Estimate the camera pose of every frame.

    Args:
        frame: reads frame i; each is read once, in order.
        matrix: (3, 3) K, px, the left-most pixel centered at 0.5.
        relative_depth: the depth scale may differ between frames; new points are scaled to the old ones.
    """
    opencv = matrix.copy()
    opencv[:2, 2] -= 0.5  # OpenCV counts pixel centers from 0
    poses, explained, scales = np.tile(np.eye(4), (count, 1, 1)), np.ones(count, bool), np.ones(count)
    seen = frame(0)
    gray = _gray(seen)
    pixels, points = _new_points(seen, gray, opencv, np.eye(4), 1.0, np.zeros((0, 2), np.float32))
    for index in range(1, count):
        seen, before = frame(index), gray
        gray = _gray(seen)
        kept, found = _follow(before, gray, pixels, seen.tissue_mask)
        pixels, points = found, points[kept]
        pose, inliers = _solve(points, pixels, opencv, poses[index - 1])
        explained[index] = pose is not None
        poses[index] = poses[index - 1] if pose is None else pose
        scales[index] = scales[index - 1]
        if pose is not None:
            if relative_depth:
                scales[index] = _scale(seen.depth, points[inliers], pixels[inliers], pose)
            pixels, points = pixels[inliers], points[inliers]
        if len(points) < REFRESH * MAX_CORNERS:
            more = _new_points(seen, gray, opencv, poses[index], float(scales[index]), pixels)
            pixels, points = np.concatenate([pixels, more[0]]), np.concatenate([points, more[1]])
    return PosePath(poses, explained, scales)


def read_poses(path: Path, count: int) -> PosePath:
    """Read poses: .npy of (T, 4, 4) or (T, 3, 4) camera-to-world in mm, or `poses_bounds.npy` (T, 17).

    Raises:
        InputError: the file is unreadable, has another shape, or holds values that are not rotations.
    """
    hint = "Write (T, 4, 4) camera-to-world matrices in mm, OpenCV axes."
    stored = read_numpy(path, "camera poses", hint)
    shape = getattr(stored, "shape", None)
    if shape not in ((count, 4, 4), (count, 3, 4), (count, 17)):
        raise input_error(path, f"shape ({count}, 4, 4), one pose per frame", str(shape or "an archive"), hint)
    if stored.dtype.kind not in "iuf":
        raise input_error(path, "numbers", str(stored.dtype), hint)
    values = stored.astype(np.float64)
    if shape == (count, 17):
        values = values[:, :15].reshape(count, 3, 5)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3] = values[:, :3, :4]
    if not np.isfinite(poses).all():
        raise input_error(path, "finite numbers", "NaN or infinity", hint)
    demand_rotations(path, poses[:, :3, :3], "the upper left 3x3", hint)
    return PosePath(poses, np.ones(count, bool), np.ones(count))


def _gray(seen: PoseInput) -> NDArray[np.uint8]:
    return cv2.cvtColor(seen.rgb_u8, cv2.COLOR_RGB2GRAY)


def _new_points(
    seen: PoseInput, gray: NDArray[np.uint8], matrix: NDArray, pose: NDArray, scale: float, taken: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """New corners (P, 2) on smooth tissue with depth, away from those `taken`, and their world points (P, 3)."""
    depth = seen.depth
    near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    allowed = ((near > 0) & (far - near < EDGE_STEP * depth)).astype(np.uint8)
    allowed &= cv2.erode(seen.tissue_mask.astype(np.uint8), np.ones((7, 7)))
    for x, y in taken:
        cv2.circle(allowed, (round(float(x)), round(float(y))), 7, 0, -1)
    corners = cv2.goodFeaturesToTrack(gray, max(MAX_CORNERS - len(taken), 1), 0.005, 7, mask=allowed)
    if corners is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 3))
    pixels = corners[:, 0]
    z = depth[np.round(pixels[:, 1]).astype(int), np.round(pixels[:, 0]).astype(int)] * scale
    x = (pixels[:, 0] - matrix[0, 2]) / matrix[0, 0] * z
    y = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1] * z
    return pixels, np.stack([x, y, z], 1) @ pose[:3, :3].T + pose[:3, 3]


def _follow(
    before: NDArray[np.uint8], now: NDArray[np.uint8], pixels: NDArray[np.float32], tissue: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Track points by Lucas-Kanade flow with a forward-backward check: indices of the points kept, their pixels."""
    if not len(pixels):
        return np.zeros(0, np.intp), pixels
    options = {"winSize": (21, 21), "maxLevel": 4}
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, pixels[:, None], None, **options)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None, **options)
    there, back = there[:, 0], back[:, 0]
    height, width = now.shape
    inside = (there >= 0).all(1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    at = np.clip(np.round(there).astype(int), 0, (width - 1, height - 1))
    good = (found & found_back).ravel().astype(bool) & inside & (np.abs(back - pixels).max(1) < 1)
    good &= tissue[at[:, 1], at[:, 0]]
    kept = np.flatnonzero(good)
    return kept, there[kept]


def _solve(
    points: NDArray[np.float64], pixels: NDArray[np.float32], matrix: NDArray, guess: NDArray
) -> tuple[NDArray[np.float64] | None, NDArray[np.intp]]:
    """Camera-to-world pose (4, 4) and its inliers; None if there are too few."""
    none = np.zeros(0, np.intp)
    if len(points) < MIN_POINTS:
        return None, none
    inverse = np.linalg.inv(guess)
    turn, shift = cv2.Rodrigues(inverse[:3, :3])[0], inverse[:3, 3:].copy()
    cv2.setRNGSeed(0)
    done, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels.astype(np.float64), matrix, None, turn, shift, True,
        iterationsCount=200, reprojectionError=ERROR_PX * 2 * matrix[0, 2], confidence=0.999,
    )  # fmt: skip
    if not done or inliers is None or len(inliers) < max(MIN_POINTS / 2, MIN_INLIERS * len(points)):
        return None, none
    inliers = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(points[inliers], pixels[inliers].astype(np.float64), matrix, None, turn, shift)
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return np.linalg.inv(world_to_camera), inliers


def _scale(depth: NDArray[np.float32], points: NDArray, pixels: NDArray[np.float32], pose: NDArray) -> float:
    """Median ratio of the points' z to the depth map; 1 where no depth is measured."""
    inverse = np.linalg.inv(pose)
    z = points @ inverse[2, :3] + inverse[2, 3]
    at = np.clip(np.round(pixels).astype(int), 0, (depth.shape[1] - 1, depth.shape[0] - 1))
    measured = depth[at[:, 1], at[:, 0]]
    good = (measured > 0) & (z > 0)
    return float(np.median(z[good] / measured[good])) if good.any() else 1.0
