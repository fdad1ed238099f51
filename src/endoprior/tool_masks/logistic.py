"""Logistic regression on few features, by damped Newton steps.

`n` examples, `k` features.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MOST_STEPS = 20
SMALLEST_STEP = 1e-3
"""A Newton step is halved until the loss falls; below this share of it the fit is done."""
SMALL_GAIN = 1e-3
"""The fit is done when a step lowers the loss by less."""


def fit_logistic(
    features: NDArray, is_tool: NDArray[np.bool_], weight: NDArray, offset: NDArray, ridge: float
) -> NDArray[np.float64]:
    """(k + 1,) coefficients of the features, and a constant, that are added to the offset to give log-odds.

    Args:
        features: (n, k), of a standard deviation near 1.
        is_tool: (n,).
        weight: (n,) at least 0.
        offset: (n,) log-odds that are known before.
        ridge: penalty of squared coefficients, above 0, which holds them near 0; the constant has hardly any.
    """
    x = np.hstack([features, np.ones((len(features), 1))]).astype(np.float64)
    penalty, sign = np.append(np.full(features.shape[1], ridge), 1e-3), np.where(is_tool, 1.0, -1.0)
    found = np.zeros(x.shape[1])

    def loss(at: NDArray) -> float:
        return float(weight @ np.logaddexp(0, -sign * (offset + x @ at)) + penalty @ at**2 / 2)

    now = loss(found)
    for _ in range(MOST_STEPS):
        p = probability(offset + x @ found)
        gradient = x.T @ (weight * (p - is_tool)) + penalty * found
        curvature = (x * (weight * p * (1 - p))[:, None]).T @ x + np.diag(penalty)
        step, share = np.linalg.solve(curvature, gradient), 1.0
        while (then := loss(found - share * step)) > now:
            share /= 2
            if share < SMALLEST_STEP:
                return found
        found, gain, now = found - share * step, now - then, then
        if gain < SMALL_GAIN:
            break
    return found


def probability(log_odds: NDArray) -> NDArray:
    """Of log-odds; without overflow."""
    return 1 / (1 + np.exp(-np.clip(log_odds, -50, 50)))
