"""Fit temporal coefficients to tracks: as they are across the ray of a point's source pixel, smoothly along it.

Measured depth errs by ten times as much as flow does, and its errors move a point along the ray. Followed as they are,
they make tissue that rests tremble. So what moves along the ray bends as little as cross-validation allows: not at all
where depth is noise, freely where tissue moves. `T` frames, `N` points, `B` basis functions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.config_deformation import BasisConfig
from ..model.motion import basis_weights

RIDGE = 1e-5  # ridge term of least squares; each frame has weight 1
STIFFNESS = tuple(10.0 ** np.arange(-0.5, 4.1, 0.5))
"""Weights, relative to a frame, of the squared second difference along time, in steps of the median time between
frames. The stiffest leaves little more than a straight line."""


def fit_motion(
    offsets: NDArray[np.floating], rays: NDArray[np.floating], times: list[float], cfg: BasisConfig
) -> NDArray[np.float32]:
    """Coefficients (N, B, 3) of offsets (T, N, 3) mm at T `times` in [0, 1], smooth along the unit `rays` (N, 3)."""
    weights = np.stack([basis_weights(time, cfg) for time in times])
    plain = solver(weights, times, 0.0)
    coefficients = (plain @ offsets.reshape(len(times), -1)).reshape(cfg.num_bases, -1, 3)
    if len(times) > 2:
        along = np.einsum("tnc,nc->tn", offsets, rays)
        smooth = solver(weights, times, best_stiffness(along, weights, times))
        coefficients += ((smooth - plain) @ along)[..., None] * rays
    return np.ascontiguousarray(coefficients.transpose(1, 0, 2), np.float32)


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
