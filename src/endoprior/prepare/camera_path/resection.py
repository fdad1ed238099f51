"""The pose of one frame from points whose position is known: RANSAC for a start, then re-weighted least squares."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .adjust import DEPTH_WIDTH, SINGLE_WIDTH
from .residuals import derivatives, geman_mcclure, moved, residuals

INLIER_PX = 2.5
"""Largest reprojection error of an inlier of RANSAC, px of an image 640 px wide."""
FEWEST = 12
"""With fewer points there is no pose."""


@dataclass(frozen=True)
class Resected:
    """A pose and how sure it is."""

    pose: NDArray[np.float64]
    """(4, 4) world-to-camera."""
    inlier: NDArray[np.bool_]
    """(N,) points that it explains."""
    translation_std: float
    """Of the camera center, mm; the points count as known."""
    rotation_std: float
    """rad."""


def coarse_pose(
    matrix: NDArray, points: NDArray, pixels: NDArray, guess: NDArray | None, inlier_px: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """World-to-camera (4, 4) by perspective-n-point with RANSAC, and (N,) its inliers; None if there is none."""
    if len(points) < FEWEST:
        return None
    turn = shift = None
    if guess is not None:
        turn, shift = cv2.Rodrigues(guess[:3, :3])[0], guess[:3, 3:].copy()
    cv2.setRNGSeed(0)
    done, turn, shift, found = cv2.solvePnPRansac(
        points, pixels.astype(np.float64), matrix, None, turn, shift, guess is not None,
        iterationsCount=200, reprojectionError=inlier_px, confidence=0.999,
    )  # fmt: skip
    if not done or found is None or len(found) < FEWEST or not np.isfinite(turn).all():
        return None
    inlier = np.zeros(len(points), bool)
    inlier[found.ravel()] = True
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose, inlier


def refined_pose(
    matrix: NDArray, pose: NDArray, points: NDArray, pixels: NDArray, inverse_depth: NDArray, sigma: NDArray,
    track_weight: NDArray, *, steps: int = 8, widest: float = 4.0,
) -> Resected:  # fmt: skip
    """Refine a pose; residuals in standard deviations are weighted by their track and by Geman-McClure.

    Args:
        sigma: (N, 2) px and 1/mm, as in `residuals`.
        track_weight: (N,) 0..1.
        widest: the weight's width starts at this multiple of its final one, and halves with each step.
    """
    for step in range(steps):
        width = SINGLE_WIDTH * max(1.0, widest / 2**step)
        error = residuals(matrix, pose, points, pixels, inverse_depth, sigma)
        weight = _weights(error, track_weight, width)
        normal, gradient = _normal(matrix, pose, points, sigma, error, weight)
        change = -np.linalg.solve(normal + np.diag(1e-6 * np.diag(normal) + 1e-9), gradient)
        pose = moved(pose[None], change[None])[0]
        if width == SINGLE_WIDTH and np.abs(change).max() < 1e-7:
            break
    error = residuals(matrix, pose, points, pixels, inverse_depth, sigma)
    squared = (error[:, :2] ** 2).sum(1)
    weight = _weights(error, track_weight, SINGLE_WIDTH)
    normal, _ = _normal(matrix, pose, points, sigma, error, weight)
    # The residuals themselves say how large the errors are: the tracker's vary from clip to clip.
    variance = float((weight[:, 0] * squared).sum() / max(2 * weight[:, 0].sum() - 6, 1))
    covariance = np.linalg.inv(normal + 1e-9 * np.eye(6)) * variance
    spread = np.sqrt(np.maximum([np.trace(covariance[3:, 3:]), np.trace(covariance[:3, :3])], 0))
    return Resected(pose, squared < SINGLE_WIDTH**2, float(spread[0]), float(spread[1]))


def _weights(error: NDArray, track_weight: NDArray, width: float) -> NDArray[np.float64]:
    pixel = track_weight * geman_mcclure((error[:, :2] ** 2).sum(1), width)
    depth = track_weight * geman_mcclure(error[:, 2] ** 2, DEPTH_WIDTH)
    return np.stack([pixel, pixel, depth], 1)


def _normal(
    matrix: NDArray, pose: NDArray, points: NDArray, sigma: NDArray, error: NDArray, weight: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    by_pose = derivatives(matrix, pose, points, sigma)[0].reshape(-1, 6)
    weighted = by_pose * weight.reshape(-1, 1)
    return weighted.T @ by_pose, weighted.T @ error.ravel()
