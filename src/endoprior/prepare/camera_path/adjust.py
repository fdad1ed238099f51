"""Least squares for the camera path: bundle adjustment of poses and points, and the pose of one frame.

`K` cameras, `P` points, `N` observations. A pose is world-to-camera; it changes to [exp(w), v] o pose for a small step
(w, v) in camera axes. Residuals are reprojection in px and measured depth in disparity. Weights are those of
Geman-McClure: one for each track, from the mean of its residuals over time, so that tissue that breathes or is pulled
falls out by its history; one for each observation, against single mistakes; one for each measured depth. They are
updated between the steps (iterative re-weighting).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

NEAREST_MM = 1e-3
"""Points nearer than this, or behind the camera, are held at it: finite residuals, far from any inlier."""
TRACK_WIDTH = (1.5, 6.0)  # least and largest width of a track's weight; between them twice the median of the tracks
SINGLE_WIDTH = 4.0  # width of the weight of one observation, standard deviations
DEPTH_WIDTH = 3.0  # width of the weight of one depth, standard deviations
DENSE_LIMIT = 900  # up to this many unknowns of the cameras, their system is solved as a dense matrix
INLIER_PX = 2.5  # largest reprojection error of an inlier of RANSAC, px of an image 640 px wide
MIN_POINTS = 12  # with fewer points there is no pose


def residuals(
    matrix: NDArray, poses: NDArray, points: NDArray, pixels: NDArray, inverse_depth: NDArray, sigma: NDArray
) -> NDArray:
    """(N, 3) standardized residuals: u, v, and inverse depth 1/z (Eq.: disparity = f b / z).

    Args:
        matrix: (3, 3) K, px.
        poses: (N, 4, 4) or (4, 4) world-to-camera.
        points: (N, 3) world points, mm, which were seen at `pixels`: (N, 2).
        inverse_depth: (N,) 1 / measured depth, 1/mm.
        sigma: (N, 2) standard deviation of a pixel, px, and of the inverse depth, 1/mm; inf where none was measured.
    """
    seen = _in_camera(poses, points)
    z = np.maximum(seen[:, 2], NEAREST_MM)
    u = matrix[0, 0] * seen[:, 0] / z + matrix[0, 2] - pixels[:, 0]
    v = matrix[1, 1] * seen[:, 1] / z + matrix[1, 2] - pixels[:, 1]
    return np.stack([u / sigma[:, 0], v / sigma[:, 0], (1 / z - inverse_depth) / sigma[:, 1]], 1)


def derivatives(matrix: NDArray, poses: NDArray, points: NDArray, sigma: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Derivatives of `residuals`: (N, 3, 6) by the pose step (w, v), (N, 3, 3) by the point, (N, 3) by log f."""
    seen = _in_camera(poses, points)
    x, y = seen[:, 0], seen[:, 1]
    z = np.maximum(seen[:, 2], NEAREST_MM)
    zero = np.zeros_like(z)
    a, b = matrix[0, 0] / z / sigma[:, 0], matrix[1, 1] / z / sigma[:, 0]
    entries = a, zero, -a * x / z, zero, b, -b * y / z, zero, zero, -1 / (z * z * sigma[:, 1])
    by_seen = np.stack(entries, 1).reshape(-1, 3, 3)
    turned = np.stack([zero, seen[:, 2], -y, -seen[:, 2], zero, x, y, -x, zero], 1).reshape(-1, 3, 3)  # -[X]_x
    by_pose = np.concatenate([by_seen @ turned, by_seen], 2)
    by_focal = np.stack([a * x, b * y, zero], 1)
    return by_pose, by_seen @ poses[..., :3, :3], by_focal


def moved(poses: NDArray, steps: NDArray) -> NDArray:
    """(K, 4, 4) poses after steps (K, 6) of rotation, rad, and translation, mm, in camera axes."""
    out = poses.copy()
    for k, step in enumerate(steps):
        turn = cv2.Rodrigues(step[:3])[0]
        out[k, :3, :3] = turn @ poses[k, :3, :3]
        out[k, :3, 3] = turn @ poses[k, :3, 3] + step[3:]
    return out


def back_projected(matrix: NDArray, pose: NDArray, pixels: NDArray, z: NDArray) -> NDArray:
    """(N, 3) world points of pixels (N, 2) at depth z (N,) mm, seen from a world-to-camera pose."""
    x = (pixels[:, 0] - matrix[0, 2]) / matrix[0, 0] * z
    y = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1] * z
    return (np.stack([x, y, z], 1) - pose[:3, 3]) @ pose[:3, :3]


def _in_camera(poses: NDArray, points: NDArray) -> NDArray:
    return (poses[..., :3, :3] @ points[:, :, None])[:, :, 0] + poses[..., :3, 3]


@dataclass(frozen=True)
class Observations:
    """Which camera saw which point where."""

    camera: NDArray  # (N,) 0..K-1
    point: NDArray  # (N,) 0..P-1
    pixels: NDArray  # (N, 2) px
    inverse_depth: NDArray  # (N,) 1 / measured depth, 1/mm; anything finite where its sigma is inf
    sigma: NDArray  # (N, 2) standard deviations: px, 1/mm


@dataclass(frozen=True)
class Adjusted:
    """Result of the adjustment."""

    poses: NDArray  # (K, 4, 4) world-to-camera
    points: NDArray  # (P, 3) mm
    track_weight: NDArray  # (P,) 0..1: how well the track follows the rigid scene over time
    focal_factor: float  # of the focal length; 1 where it is fixed
    focal_std: float  # standard deviation of its logarithm; 0 where it is fixed


def adjust(
    matrix: NDArray, poses: NDArray, points: NDArray, seen: Observations, fixed: NDArray[np.bool_], *,
    rounds: int = 4, steps: int = 2, focal_prior: float = 0.0, widest: float = 1.0,
) -> Adjusted:  # fmt: skip
    """Adjust poses (K, 4, 4) world-to-camera and points (P, 3), mm, to what was seen.

    Args:
        matrix: (3, 3) K, px.
        fixed: (K,) cameras that stay; at least one, or the world drifts.
        rounds, steps: updates of the weights, and Levenberg-Marquardt steps after each.
        focal_prior: standard deviation of log f; 0 keeps the focal length.
        widest: the widths of the weights start at this multiple and halve with each round: a path that drifted has
            large residuals where it returns, and they must not count as moving tissue.
    """
    log_f, focal_std, damping = 0.0, 0.0, 1e-4
    track = np.ones(len(points))
    for turn in range(rounds):
        error = _error(matrix, poses, points, seen, log_f)
        weight, track = weights(error, seen.point, len(points), max(1.0, widest / 2**turn))
        for _ in range(steps):
            system = _System(matrix, poses, points, seen, fixed, weight, log_f, focal_prior)
            for _ in range(5):
                camera_step, point_step, focal_step = system.solve(damping)
                new = moved(poses, camera_step), points + point_step, log_f + focal_step
                error = _error(matrix, new[0], new[1], seen, new[2])
                if _cost(error, weight, new[2], focal_prior) <= system.cost:
                    poses, points, log_f = new
                    damping = max(damping / 5, 1e-8)
                    break
                damping *= 10
            focal_std = system.focal_std() if focal_prior else 0.0
    return Adjusted(poses, points, track, float(np.exp(log_f)), focal_std)


def geman_mcclure(squared: NDArray, width: float) -> NDArray:
    """Weight in (0, 1] of residuals with these squares: (c^2 / (c^2 + r^2))^2."""
    return (width * width / (width * width + squared)) ** 2


def weights(error: NDArray, point: NDArray, count: int, wider: float = 1.0) -> tuple[NDArray, NDArray]:
    """Weights (N, 3) of standardized residuals (N, 3), and (count,) of the tracks they belong to.

    The width of the track weight follows the data: where more than half of the tissue moves, rigid is what moves least.
    """
    squared = (error[:, :2] ** 2).sum(1)
    # One gross mistake must not condemn a long track: each residual counts up to twice the largest width.
    capped = np.minimum(squared, (2 * wider * TRACK_WIDTH[1]) ** 2)
    number = np.bincount(point, minlength=count)
    history = np.bincount(point, weights=capped, minlength=count) / np.maximum(number, 1)
    usual = float(np.sqrt(np.median(history[number > 1]))) if (number > 1).any() else TRACK_WIDTH[1]
    width = wider * float(np.clip(2 * usual, *TRACK_WIDTH))
    track = geman_mcclure(history, width)
    return _weights(error, track[point], max(wider * SINGLE_WIDTH, 1.5 * width), wider * DEPTH_WIDTH), track


def _weights(error: NDArray, track: NDArray, width: float, depth_width: float = DEPTH_WIDTH) -> NDArray:
    pixel = track * geman_mcclure((error[:, :2] ** 2).sum(1), width)
    return np.stack([pixel, pixel, track * geman_mcclure(error[:, 2] ** 2, depth_width)], 1)


def _error(matrix: NDArray, poses: NDArray, points: NDArray, seen: Observations, log_f: float) -> NDArray:
    here = poses[seen.camera], points[seen.point]
    return residuals(_scaled(matrix, log_f), *here, seen.pixels, seen.inverse_depth, seen.sigma)


def _cost(error: NDArray, weight: NDArray, log_f: float, focal_prior: float) -> float:
    return float((weight * error**2).sum()) + ((log_f / focal_prior) ** 2 if focal_prior else 0.0)


def _scaled(matrix: NDArray, log_f: float) -> NDArray:
    out = np.array(matrix, np.float64)
    out[[0, 1], [0, 1]] *= np.exp(log_f)
    return out


class _System:
    """The normal equations at one state: cameras (and log f) first, points second."""

    def __init__(
        self, matrix: NDArray, poses: NDArray, points: NDArray, seen: Observations, fixed: NDArray[np.bool_],
        weight: NDArray, log_f: float, focal_prior: float,
    ) -> None:  # fmt: skip
        error = _error(matrix, poses, points, seen, log_f)
        self.cost = _cost(error, weight, log_f, focal_prior)
        self.fixed, self.has_focal = fixed, bool(focal_prior)
        root = np.sqrt(weight)
        parts = derivatives(_scaled(matrix, log_f), poses[seen.camera], points[seen.point], seen.sigma)
        by_pose, by_point = (part * root[:, :, None] for part in parts[:2])
        error = error * root
        slot = np.cumsum(~fixed) - 1
        columns = np.where(fixed[:, None], 0, 6 * slot[:, None] + np.arange(6))[seen.camera]
        by_pose = np.where(fixed[seen.camera][:, None, None], 0.0, by_pose)
        self.size = 6 * int((~fixed).sum()) + self.has_focal
        if self.has_focal:
            columns = np.concatenate([columns, np.full((len(columns), 1), self.size - 1)], 1)
            by_pose = np.concatenate([by_pose, (parts[2] * root)[:, :, None]], 2)
        cameras = _rows(by_pose, columns, max(self.size, 1))
        of_points = _rows(by_point, 3 * seen.point[:, None] + np.arange(3), 3 * len(points))
        residual = error.ravel()
        self.of_cameras = (cameras.T @ cameras).tocsr()
        self.mixed = (cameras.T @ of_points).tocsr()
        self.of_points = summed_by(seen.point, np.einsum("nij,nik->njk", by_point, by_point), len(points))
        self.camera_gradient, self.point_gradient = cameras.T @ residual, of_points.T @ residual
        if self.has_focal:
            prior = sparse.csr_matrix(([focal_prior**-2], ([self.size - 1], [self.size - 1])), (self.size, self.size))
            self.of_cameras = self.of_cameras + prior
            self.camera_gradient[-1] += log_f / focal_prior**2

    def solve(self, damping: float) -> tuple[NDArray, NDArray, float]:
        """Steps of the poses (K, 6), of the points (P, 3) and of log f."""
        inverse = self._inverse(damping)
        right = self.camera_gradient - self.mixed @ (inverse @ self.point_gradient)
        step = np.zeros(len(right))
        if self.size:
            reduced = self._reduced(inverse, damping)
            if self.size <= DENSE_LIMIT:
                step = -np.linalg.solve(reduced.toarray(), right)
            else:
                step = -splu(reduced.tocsc()).solve(right)
        point_step = -(inverse @ (self.point_gradient + self.mixed.T @ step))
        camera_step = np.zeros((len(self.fixed), 6))
        camera_step[~self.fixed] = step[: self.size - self.has_focal].reshape(-1, 6)
        return camera_step, point_step.reshape(-1, 3), float(step[-1]) if self.has_focal else 0.0

    def focal_std(self) -> float:
        """Standard deviation of log f, poses and points unknown too."""
        unit = np.zeros(self.size)
        unit[-1] = 1
        reduced = self._reduced(self._inverse(1e-9), 1e-9)
        return float(np.sqrt(max(splu(reduced.tocsc()).solve(unit)[-1], 0.0)))

    def _inverse(self, damping: float) -> sparse.csr_array:
        count = len(self.of_points)
        diagonal = np.einsum("nii->ni", self.of_points)
        least = 1e-9 * (1 + diagonal.max(1, keepdims=True))
        blocks = self.of_points + (damping * diagonal + least)[:, :, None] * np.eye(3)
        return sparse.bsr_matrix((np.linalg.inv(blocks), np.arange(count), np.arange(count + 1))).tocsr()

    def _reduced(self, inverse: sparse.csr_array, damping: float) -> sparse.csr_array:
        held = sparse.diags(self.of_cameras.diagonal() * damping + 1e-9)
        return self.of_cameras + held - self.mixed @ inverse @ self.mixed.T


def summed_by(point: NDArray, values: NDArray, count: int) -> NDArray:
    """(count, ...) sums over the observations of each point, of values (N, ...)."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    sums = [np.bincount(point, weights=column, minlength=count) for column in flat.T]
    return np.stack(sums, 1).reshape(count, *values.shape[1:])


def _rows(values: NDArray, columns: NDArray, width: int) -> sparse.csr_matrix:
    """Sparse (3 N, width) from derivatives (N, 3, C) by the columns (N, C)."""
    count, _, each = values.shape
    indices = np.repeat(columns[:, None], 3, 1).ravel()
    return sparse.csr_matrix((values.ravel(), indices, np.arange(0, 3 * count * each + 1, each)), (3 * count, width))


@dataclass(frozen=True)
class Resected:
    """A pose and how sure it is."""

    pose: NDArray  # (4, 4) world-to-camera
    inlier: NDArray[np.bool_]  # (N,) points that it explains
    translation_std: float  # of the camera center, mm; the points count as known
    rotation_std: float  # rad


def coarse_pose(
    matrix: NDArray, points: NDArray, pixels: NDArray, start: NDArray | None, inlier_px: float
) -> tuple[NDArray, NDArray] | None:
    """World-to-camera (4, 4) by perspective-n-point with RANSAC, and (N,) its inliers; None if there is none."""
    if len(points) < MIN_POINTS:
        return None
    turn = shift = None
    if start is not None:
        turn, shift = cv2.Rodrigues(start[:3, :3])[0], start[:3, 3:].copy()
    cv2.setRNGSeed(0)
    done, turn, shift, found = cv2.solvePnPRansac(
        points, pixels.astype(np.float64), matrix, None, turn, shift, start is not None,
        iterationsCount=200, reprojectionError=inlier_px, confidence=0.999,
    )  # fmt: skip
    if not done or found is None or len(found) < MIN_POINTS or not np.isfinite(turn).all():
        return None
    inlier, pose = np.isin(np.arange(len(points)), found), np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose, inlier


def refined_pose(
    matrix: NDArray, pose: NDArray, points: NDArray, pixels: NDArray, inverse_depth: NDArray, sigma: NDArray,
    track_weight: NDArray,
) -> Resected:  # fmt: skip
    """Refine a pose; residuals in standard deviations are weighted by their track, (N,), and by Geman-McClure."""

    def linearized(pose: NDArray, width: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Residuals, their weights, normal matrix and gradient."""
        error = residuals(matrix, pose, points, pixels, inverse_depth, sigma)
        weight = _weights(error, track_weight, width)
        by_pose = derivatives(matrix, pose, points, sigma)[0].reshape(-1, 6)
        weighted = by_pose * weight.reshape(-1, 1)
        return error, weight, weighted.T @ by_pose, weighted.T @ error.ravel()

    for wider in (4.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0):
        width = SINGLE_WIDTH * wider
        _, _, normal, gradient = linearized(pose, width)
        change = -np.linalg.solve(normal + np.diag(1e-6 * np.diag(normal) + 1e-9), gradient)
        pose = moved(pose[None], change[None])[0]
        if width == SINGLE_WIDTH and np.abs(change).max() < 1e-7:
            break
    error, weight, normal, _ = linearized(pose, SINGLE_WIDTH)
    squared = (error[:, :2] ** 2).sum(1)
    # The residuals themselves say how large the errors are: the tracker's vary from clip to clip.
    variance = float((weight[:, 0] * squared).sum() / max(2 * weight[:, 0].sum() - 6, 1))
    covariance = np.linalg.inv(normal + 1e-9 * np.eye(6)) * variance
    std = np.sqrt(np.maximum([np.trace(covariance[3:, 3:]), np.trace(covariance[:3, :3])], 0))
    return Resected(pose, squared < SINGLE_WIDTH**2, float(std[0]), float(std[1]))
