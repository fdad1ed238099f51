"""Material points carried by the Gaussians: where tissue that is at x now will be, or was, at other times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .scene import Scene

NUM_CARRIERS = 8
"""Gaussians that carry a point."""


def carry_points(
    scene: Scene, points: NDArray, from_frame: NDArray[np.intp], times: list[float]
) -> NDArray[np.float32]:
    """Move points with the Gaussians around them.

    A point is tied, at the time of its frame, to the 8 nearest Gaussians; it then moves by the mean of their
    displacements, weighted by opacity and by a Gaussian of the distance whose width is the mean distance of the eight.

    Args:
        points: (P, 3) world positions, mm.
        from_frame: (P,) position in `times` at which each point is where `points` says.
        times: T times in [0, 1].
    Returns:
        (T, P, 3) world positions, mm.
    """
    centers = np.stack([scene.at(time).means.cpu().numpy() for time in times])
    opacities = scene.gaussians.opacities.detach().cpu().numpy()
    moved = np.empty((len(times), *points.shape), np.float32)
    k = min(NUM_CARRIERS, len(scene))
    for start in np.unique(from_frame):
        tied = np.flatnonzero(from_frame == start)
        distances, carriers = cKDTree(centers[start]).query(points[tied], k=k, workers=1)
        distances, carriers = distances.reshape(len(tied), k), carriers.reshape(len(tied), k)
        width = np.maximum(distances.mean(1, keepdims=True), 1e-6)
        weights = opacities[carriers] * np.exp(-0.5 * (distances / width) ** 2) + 1e-12
        weights /= weights.sum(1, keepdims=True)
        for i, there in enumerate(centers):  # one time after the other: many points at many times fit in memory
            displacement = there[carriers] - centers[start, carriers]
            moved[i, tied] = points[tied] + np.einsum("pkc,pk->pc", displacement, weights)
    return moved
