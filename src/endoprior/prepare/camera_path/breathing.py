"""Periodic motion of the tissue, told apart from the camera: breathing moves all of the view, and so would a camera.

Point p lies at X_p + sum_h phi(X_p) (A_h cos(h w t) + B_h sin(h w t)), with phi = (1, a, b, a^2, a b, b^2) of its place
along the tissue and w the frequency of a breath. Motion of this form that all points share may belong to the camera or
to the tissue: it is given to the tissue, by the prior that a camera accelerates seldom (L1 norm of its acceleration).
What a camera does in the very rhythm of the breath is therefore lost. `K` frames, `P` points, `N` observations.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from .adjust import Observations, derivatives, moved, residuals, summed_by, weights
from .follow import Follower

HARMONICS, ROUNDS = 2, 8
CYCLES = 3.0  # fewer breaths are not told from the camera
SHORTEST = 8  # frames of the fastest breath
SAMPLE = 4000  # observations from which the period is found
SPACING = 12  # frames of a breath that are adjusted, and ...
MAX_CAMERAS = 220  # ... at most in all: a longer clip is left to the camera
SIGNIFICANT = 0.03  # share of the residuals that one period must explain ...
PEAK = 10.0  # ... and how many times more than the median period
SMOOTH = 20.0  # weight of the acceleration of the camera, 1/mm; rotation counts at the distance of the tissue
STILL_MM = 0.01  # changes of speed far below this count quadratically, mm per step
COEFFICIENT_MM = 5.0  # prior standard deviation of A and B, mm


@dataclass(frozen=True)
class Breathing:
    """Displacement of every point in every frame."""

    period: float  # frames
    basis: NDArray  # (P, 6) phi of each point
    coefficients: NDArray  # (6, 2 * HARMONICS, 3) mm

    def at(self, frame: int, ids: NDArray) -> NDArray:
        """(N, 3) displacement of points, mm."""
        wave = waves(np.array([frame]), self.period)[0]
        return self.basis[ids] @ np.einsum("bhj,h->bj", self.coefficients, wave)


def waves(frames: NDArray, period: float) -> NDArray:
    """(N, 2 * HARMONICS) cosines and sines of the frames."""
    angle = 2 * np.pi * np.asarray(frames, np.float64)[:, None] / period * np.arange(1, HARMONICS + 1)
    return np.concatenate([np.cos(angle), np.sin(angle)], 1)


def surface_basis(points: NDArray) -> NDArray:
    """(P, 6) 1, a, b, a^2, a b, b^2 of the place of each point (P, 3) along the tissue, about 1 in size."""
    spread = points - np.median(points, 0)
    size = np.maximum(np.median(np.linalg.norm(spread, axis=1)), 1e-9)
    kept = spread[np.linalg.norm(spread, axis=1) < 4 * size]
    axes = np.linalg.svd(kept, full_matrices=False)[2][:2]
    a, b = np.clip(spread @ axes.T / size, -3, 3).T
    return np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], 1)


def separate_breathing(follower: Follower, keyframes: list[int]) -> Breathing | None:
    """Find the period of the tissue and give its motion to the points; None if there is none, or it cannot be told.

    Poses of the frames that take part, points and weights of the follower change with it.
    """
    tracks, camera = follower.tracks, follower.camera
    everything = np.arange(keyframes[0], keyframes[-1] + 1)
    found = _period(follower, everything[:: max(1, len(everything) // 300)])
    if found is None:
        return None
    step = max(1, round(found / SPACING))
    frames = np.union1d(everything[::step], keyframes)
    if len(frames) > MAX_CAMERAS:
        return None
    ids, seen = tracks.of_frames(list(frames), follower.scales)
    poses, points, coefficients, weight = separate(
        camera.matrix, follower.poses[frames], tracks.points[ids], seen, frames, found
    )
    if not (np.isfinite(poses).all() and np.isfinite(points).all()):
        return None
    basis = np.zeros((tracks.count, 6))
    basis[ids] = surface_basis(tracks.points[ids])
    follower.poses[frames], tracks.points[ids], tracks.weight[ids] = poses, points, weight
    tracks.adjusted[:] = False
    tracks.adjusted[ids] = True
    return Breathing(found, basis, coefficients)


def _period(follower: Follower, frames: NDArray) -> float | None:
    """The significant period of the residuals of the rigid scene, frames."""
    tracks = follower.tracks
    ids, seen = tracks.of_frames(list(frames), follower.scales)
    some = np.flatnonzero(tracks.adjusted[ids][seen.point])
    some = some[:: max(1, len(some) // SAMPLE)]
    if len(some) < SAMPLE // 8:
        return None
    pose, here = follower.poses[frames][seen.camera[some]], tracks.points[ids][seen.point[some]]
    rest = seen.pixels[some], seen.inverse_depth[some], seen.sigma[some]
    error = residuals(follower.camera.matrix, pose, here, *rest)
    weight, _ = weights(error, np.arange(len(some)), len(some))
    by_point = derivatives(follower.camera.matrix, pose, here, seen.sigma[some])[1]
    basis = surface_basis(tracks.points[ids])[seen.point[some]][:, :3]
    return breathing_period(error, by_point, weight, basis, frames[seen.camera[some]], int(np.ptp(frames)) + 1)


def breathing_period(
    error: NDArray, by_point: NDArray, weight: NDArray, basis: NDArray, frames: NDArray, count: int
) -> float | None:
    """The period, frames, at which residuals (N, 3) repeat; None if none stands out.

    Args:
        by_point, weight: derivative of the residuals by the point, (N, 3, 3), and their weights (N, 3).
        basis: (N, B) of the place of each observation, in `frames`: (N,).
        count: frames of the clip.
    """
    frequencies = np.arange(CYCLES / count, 1 / SHORTEST, 0.5 / count)
    if not len(frequencies):
        return None
    root = np.sqrt(weight)
    right = (error * root).ravel()
    part = by_point * root[:, :, None]
    total = max(float(right @ right), 1e-12)

    def share(frequency: float) -> float:
        """Of the residuals, what a field of this frequency explains."""
        angle = 2 * np.pi * frames * frequency
        swing = basis[:, :, None] * np.stack([np.cos(angle), np.sin(angle)], 1)[:, None]
        columns = (part[:, :, None, :] * swing.reshape(len(frames), 1, -1, 1)).reshape(len(right), -1)
        gradient, normal = columns.T @ right, columns.T @ columns
        normal += np.eye(len(normal)) * 1e-3 * np.trace(normal) / len(normal)
        return float(gradient @ np.linalg.solve(normal, gradient)) / total

    shares = np.array([share(f) for f in frequencies])
    best = float(frequencies[np.argmax(shares)])
    if shares.max() < max(SIGNIFICANT, PEAK * np.median(shares)):
        return None
    fine = best + np.linspace(-0.5, 0.5, 21) / count
    return float(1 / fine[np.argmax([share(f) for f in fine])])


def separate(
    matrix: NDArray, poses: NDArray, points: NDArray, seen: Observations, frames: NDArray, period: float
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Adjust cameras (K, 4, 4), of frames (K,), points (P, 3) and motion of this period together.

    Returns:
        Poses, points, coefficients (6, 2 * HARMONICS, 3) mm, and weights of the tracks (P,).
    """
    poses, points = poses.copy(), points.copy()
    basis, wave = surface_basis(points), waves(frames, period)
    coefficients = np.zeros((basis.shape[1], wave.shape[1], 3))
    distance = float(np.median(1 / seen.inverse_depth[np.isfinite(seen.sigma[:, 1])]))
    track = np.ones(len(points))
    for _ in range(ROUNDS):
        swing = np.einsum("nb,nh->nbh", basis[seen.point], wave[seen.camera])
        here = points[seen.point] + np.einsum("nbh,bhj->nj", swing, coefficients)
        error = residuals(matrix, poses[seen.camera], here, seen.pixels, seen.inverse_depth, seen.sigma)
        weight, track = weights(error, seen.point, len(points))
        root, cameras, size = np.sqrt(weight), 6 * len(poses), 6 * len(poses) + coefficients.size
        by_pose, by_point, _ = derivatives(matrix, poses[seen.camera], here, seen.sigma)
        by_pose, by_point, error = by_pose * root[..., None], by_point * root[..., None], error * root
        normal, gradient, mixed = _normal_equations(by_pose, by_point, error, seen, basis, wave)
        _add_smoothness(normal, gradient, poses, frames, distance)
        normal[range(cameras, size), range(cameras, size)] += COEFFICIENT_MM**-2
        gradient[cameras:] += coefficients.ravel() * COEFFICIENT_MM**-2
        normal[range(6), range(6)] += 1e9  # the first camera holds the world
        step, point_step = _solve(normal, gradient, mixed, by_point, error, seen.point, len(points))
        poses = moved(poses, step[:cameras].reshape(-1, 6))
        coefficients += step[cameras:].reshape(coefficients.shape)
        points += point_step
    return poses, points, coefficients, track


def _normal_equations(
    by_pose: NDArray, by_point: NDArray, error: NDArray, seen: Observations, basis: NDArray, wave: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Normal matrix and gradient of cameras (6 K) and coefficients, and their products with the points (size, P, 3).

    The derivative by a coefficient is that by the point times basis (of the point) times wave (of the camera): sums
    over the points of a camera come first, products with its wave second.
    """
    count, cameras, points = len(error), len(wave), len(basis)
    of_camera = sparse.csr_matrix((np.ones(count), (seen.camera, np.arange(count))), (cameras, count))
    of_point = sparse.csr_matrix((np.ones(count), (seen.point, np.arange(count))), (points, count))
    b, harmonics = basis[seen.point], wave.shape[1]
    shared = b.shape[1] * harmonics * 3

    def by_camera(*factors: NDArray) -> NDArray:
        """Sums over the observations of each camera of products of (N, ...) arrays."""
        product = factors[0].reshape(count, -1)
        for factor in factors[1:]:
            product = (product[:, :, None] * factor.reshape(count, 1, -1)).reshape(count, -1)
        return of_camera @ product

    own = np.einsum("nik,nil->nkl", by_pose, by_pose)
    across = np.einsum("nik,nij->nkj", by_pose, by_point)
    inner = np.einsum("nij,nil->njl", by_point, by_point)
    first, second = np.triu_indices(b.shape[1])
    normal = np.zeros((6 * cameras + shared, 6 * cameras + shared))
    blocks = normal[: 6 * cameras, : 6 * cameras].reshape(cameras, 6, cameras, 6)
    blocks[np.arange(cameras), :, np.arange(cameras)] = by_camera(own).reshape(-1, 6, 6)
    sides = np.einsum("kxjb,kh->kxbhj", by_camera(across, b).reshape(cameras, 6, 3, -1), wave)
    normal[: 6 * cameras, 6 * cameras :] = sides.reshape(6 * cameras, shared)
    normal[6 * cameras :, : 6 * cameras] = sides.reshape(6 * cameras, shared).T
    half = by_camera(inner, b[:, first] * b[:, second]).reshape(cameras, 3, 3, -1)
    waves_twice = (wave[:, :, None] * wave[:, None]).reshape(cameras, -1)
    half = (half.reshape(cameras, -1).T @ waves_twice).reshape(3, 3, len(first), harmonics, harmonics)
    corner = np.zeros((b.shape[1], harmonics, 3, b.shape[1], harmonics, 3))
    for n, (x, y) in enumerate(zip(first, second, strict=True)):
        corner[x, :, :, y] = corner[y, :, :, x] = half[:, :, n].transpose(2, 0, 3, 1)
    normal[6 * cameras :, 6 * cameras :] = corner.reshape(shared, shared)
    pull = np.einsum("nij,ni->nj", by_point, error)
    gradient = np.concatenate([
        by_camera(np.einsum("nik,ni->nk", by_pose, error)).ravel(),
        np.einsum("kjb,kh->bhj", by_camera(pull, b).reshape(cameras, 3, -1), wave).ravel(),
    ])  # fmt: skip
    mixed = np.zeros((6 * cameras + shared, points, 3))
    places = seen.camera[:, None], np.arange(6), seen.point[:, None]
    np.add.at(mixed[: 6 * cameras].reshape(cameras, 6, points, 3), places, across)
    swung = inner.reshape(count, 9, 1) * wave[seen.camera][:, None]
    swung = (of_point @ swung.reshape(count, -1)).reshape(points, 3, 3, harmonics)
    mixed[6 * cameras :] = np.einsum("pb,pjih->bhjpi", basis, swung).reshape(shared, points, 3)
    return normal, gradient, mixed


def _solve(
    normal: NDArray, gradient: NDArray, mixed: NDArray, by_point: NDArray, error: NDArray, point: NDArray, count: int
) -> tuple[NDArray, NDArray]:
    """Steps of cameras and coefficients, and of the points (P, 3), which are eliminated."""
    own = summed_by(point, np.einsum("nij,nik->njk", by_point, by_point), count)
    pull = summed_by(point, np.einsum("nij,ni->nj", by_point, error), count)
    inverse = np.linalg.inv(own + (1e-6 * np.trace(own, axis1=1, axis2=2)[:, None, None] + 1e-6) * np.eye(3))
    eliminated = np.einsum("spj,pjk->spk", mixed, inverse)
    size = len(normal)
    reduced = normal - eliminated.reshape(size, -1) @ mixed.reshape(size, -1).T
    right = gradient - eliminated.reshape(size, -1) @ pull.ravel()
    step = -np.linalg.solve(reduced + np.eye(size) * 1e-6 * np.trace(reduced) / size / 1e3, right)
    point_step = -np.einsum("pjk,pk->pj", inverse, pull + np.einsum("spk,s->pk", mixed, step))
    return step, point_step


def _add_smoothness(normal: NDArray, gradient: NDArray, poses: NDArray, frames: NDArray, distance: float) -> None:
    """Add the L1 norm of the camera's changes of speed, re-weighted, to the normal equations of its steps."""
    motion = []
    for before, after in pairwise(poses):
        between = after @ np.linalg.inv(before)
        motion.append(np.concatenate([cv2.Rodrigues(between[:3, :3])[0].ravel(), between[:3, 3]]))
    unit = np.array([distance] * 3 + [1.0] * 3)
    pace = np.median(np.diff(frames)) / np.diff(frames)
    bends = np.diff(np.array(motion) * pace[:, None], axis=0) * unit
    weight = SMOOTH / np.sqrt(bends**2 + STILL_MM**2)
    for i, (bend, w) in enumerate(zip(bends, weight, strict=True)):
        factors = pace[i], -pace[i] - pace[i + 1], pace[i + 1]
        for k, factor in enumerate(factors):
            rows = np.arange(6 * (i + k), 6 * (i + k) + 6)
            gradient[rows] += factor * unit * w * bend
            for m, other in enumerate(factors):
                normal[rows, np.arange(6 * (i + m), 6 * (i + m) + 6)] += factor * other * unit * unit * w
