"""Fit temporal coefficients to tracks: splines that bend as little as cross-validation allows, and what they leave.

Across the ray of a point's source pixel tracks are almost free of noise: what the spline does not follow there, such as
the shake of a camera, stays with the frame that shows it, and a held-out frame in between keeps to the spline. Along
the ray measured depth errs by ten times as much as flow does. Followed as it is, it makes tissue that rests tremble; so
along it there is the spline alone, stiff where depth is noise and free where tissue moves. `T` frames, `N` points, `B`
basis functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.config_deformation import BasisConfig
from ..model.basis import spline_weights

RIDGE = 1e-5  # ridge term of least squares; each frame has weight 1
STIFFNESS = tuple(10.0 ** np.arange(-1.5, 4.1, 0.5))
"""Weights, relative to a frame, of the squared second difference along time, in steps of the median time between
frames. The stiffest leaves little more than a straight line."""


@dataclass(frozen=True)
class InitialMotion:
    """How N points move, and in which of T training frames the flow says so."""

    coefficients: NDArray[np.float32]  # (N, B, 3) of the spline of their displacement, mm
    at_frames: NDArray[np.float32]  # (N, T, 3) displacement in each frame beside the spline, mm
    followed: NDArray[np.bool_]
    """(N, T) True where the flow found the point and returned to it; elsewhere its neighbors carried it."""

    def displacement(self, weights: NDArray, position: int) -> NDArray:
        """(N, 3) mm in training frame number `position`, at whose time the spline functions have `weights` (B,)."""
        return np.tensordot(self.coefficients, weights, (1, 0)) + self.at_frames[:, position]

    def carried(self, rows: NDArray[np.integer], shares: NDArray[np.floating]) -> InitialMotion:
        """Motion of M points that the flow never found: each the mean of its `rows` (M, k), by `shares` (M, k)."""
        coefficients, at_frames = (
            np.einsum("mk,mkbc->mbc", shares, values[rows]).astype(np.float32)
            for values in (self.coefficients, self.at_frames)
        )
        return InitialMotion(coefficients, at_frames, np.zeros((len(rows), self.followed.shape[1]), bool))

    @staticmethod
    def joined(parts: Sequence[InitialMotion]) -> InitialMotion:
        """The motion of all points of several parts."""
        names = ("coefficients", "at_frames", "followed")
        return InitialMotion(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def fit_motion(
    offsets: NDArray[np.floating], rays: NDArray[np.floating], times: list[float], cfg: BasisConfig
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """`coefficients` and `at_frames` of `InitialMotion`.

    Args:
        offsets: (T, N, 3) displacement, mm, at the T `times` in [0, 1]. rays: (N, 3) unit vectors along the ray.
    """
    weights = np.stack([spline_weights(time, cfg.num_bases) for time in times])
    along = np.einsum("tnc,nc->tn", offsets, rays)
    across = (offsets - along[..., None] * rays).reshape(len(times), -1)
    of_ray, of_rest = (
        solver(weights, times, best_stiffness(values, weights, times) if len(times) > 2 else 0.0) @ values
        for values in (along, across)
    )
    left = (across - weights @ of_rest).reshape(offsets.shape)
    coefficients = of_rest.reshape(cfg.num_bases, -1, 3) + of_ray[..., None] * rays
    by_point = [np.ascontiguousarray(part.transpose(1, 0, 2), np.float32) for part in (coefficients, left)]
    return by_point[0], by_point[1]


def solver(weights: NDArray[np.floating], times: list[float], stiffness: float) -> NDArray[np.floating]:
    """(B, T) what maps values at T times to coefficients: least squares with a penalty on bending.

    Args:
        weights: (T, B) of the basis functions at `times`. stiffness: see `STIFFNESS`; 0: none.
    """
    normal = weights.T @ weights + RIDGE * np.eye(weights.shape[1])
    if stiffness:
        steps = np.asarray(times) / np.median(np.diff(times))
        slopes = np.diff(weights, axis=0) / np.diff(steps)[:, None]
        bends = 2 * np.diff(slopes, axis=0) / (steps[2:] - steps[:-2])[:, None]
        normal += stiffness * bends.T @ bends
    return np.linalg.solve(normal, weights.T)


def best_stiffness(values: NDArray[np.floating], weights: NDArray[np.floating], times: list[float]) -> float:
    """That of `STIFFNESS` with the least generalized cross-validation error (Golub, Heath and Wahba 1979).

    Args:
        values: (T, N), all fitted with the same stiffness. weights: (T, B) of the basis functions at `times`.
    """
    moments = values.astype(np.float64) @ values.T  # all that squared residuals of any linear fit depend on
    errors = []
    for stiffness in STIFFNESS:
        left = np.eye(len(times)) - weights @ solver(weights, times, stiffness)
        errors.append(np.sum(left @ moments * left) / np.trace(left) ** 2)
    return STIFFNESS[int(np.argmin(errors))]
