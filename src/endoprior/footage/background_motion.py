"""The motion of the tissue as a whole, by a camera or by breathing: smooth, a quadratic function of the place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .image_operations import Mask

ROUNDS, EVERY = 8, 7  # rounds of the robust fit; every so many pixels take part in it


def difference_from_background(flow: NDArray[np.float32], background: Mask) -> tuple[NDArray[np.float32], float]:
    """(h, w) px by which flow (h, w, 2) differs from a smooth motion that explains most of the background (h, w).

    The second value is the median there.
    """
    height, width = background.shape
    y, x = (each.ravel() for each in np.mgrid[:height, :width] / np.array([height, width])[:, None, None] - 0.5)
    terms, moved = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1), flow.reshape(-1, 2)
    some = np.flatnonzero(background)[::EVERY]
    weight, left, coefficients = np.ones(len(some)), np.zeros(len(some)), np.zeros((terms.shape[1], 2))
    for _ in range(ROUNDS):
        weighted = terms[some] * weight[:, None]
        normal = weighted.T @ terms[some] + 1e-6 * np.eye(terms.shape[1])
        coefficients = np.linalg.solve(normal, weighted.T @ moved[some])
        left = np.hypot(*(moved[some] - terms[some] @ coefficients).T)
        weight = 1 / (1 + (left / max(1.5 * np.median(left), 0.1)) ** 2)
    difference = np.hypot(*(moved - terms @ coefficients).T).reshape(height, width)
    return difference.astype(np.float32), float(np.median(left))
