"""The shape of relative depth, fixed by points that the camera's way triangulates, or by the light in a tube.

Depth from shading knows which tissue is far, not how far: brightness falls with the square of the distance r to the
lamp and with the cosine of the slope, and how much of either counts differs between a wall ahead and a tube. Where the
camera drives ahead, triangulated points say it: a power of the depth for the whole clip, log r = power * log d +
constant, and what is left at the points of each frame, spread over pixels of like depth around them. The lamp is at the
camera: r is the length of the ray, and z its part along the axis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .follow import Follower
from .path_facts import DepthShape
from .tracks import CameraPath, TrackingCamera

PARALLAX_DEGREES = 2.0  # rays to a point differ by this, or its depth is that of the shading
FEWEST = 200  # observations of such points
LEAST_POWER, MOST_POWER = 1.15, 6.0
CLEAR = 0.3  # share of the variance of log depth that the power explains


def axial_cosine(lens: TrackingCamera, size: tuple[int, int]) -> NDArray[np.float32]:
    """(H, W) cosine of the angle between the rays of the pixels and the axis. Args: size: (W, H), px."""
    x, y = np.meshgrid(*(np.arange(side, dtype=np.float64) for side in size))
    k = lens.matrix
    return np.asarray(1 / np.sqrt(1 + ((x - k[0, 2]) / k[0, 0]) ** 2 + ((y - k[1, 2]) / k[1, 1]) ** 2), np.float32)


def fitted_shape(
    path: CameraPath, follower: Follower, cosine: NDArray[np.float32], before: DepthShape | None = None
) -> DepthShape | None:
    """The shape that the path's triangulated points give the depth; `before` if there are too few, or they say little.

    Args:
        cosine: (H, W) of `axial_cosine`.
        before: what the depth that was followed has had applied already; None for nothing. One by light, without
            points, only gets another power: points that spoke too little at first rest on it now.
    """
    tracks, count = follower.tracks, len(path.explained)
    frame = np.repeat(np.arange(count), [len(ids) for ids in tracks.ids])
    ids, pixels = np.concatenate(tracks.ids), np.concatenate(tracks.pixels).astype(np.float64)
    depths = np.concatenate(tracks.depths).astype(np.float64)
    good = path.explained[frame] & tracks.adjusted[ids] & (tracks.weight[ids] > 0.3) & (depths > 0)
    frame, ids, pixels, depths = frame[good], ids[good], pixels[good], depths[good]
    if len(ids) < FEWEST:
        return before
    rays = tracks.points[ids] + np.einsum("nji,nj->ni", follower.poses[frame, :3, :3], follower.poses[frame, :3, 3])
    distance = np.linalg.norm(rays, axis=1)
    rays /= distance[:, None]
    order = np.lexsort((frame, ids))
    first = order[np.searchsorted(ids[order], ids, "left")]
    last = order[np.searchsorted(ids[order], ids, "right") - 1]
    z = np.einsum("nj,nj->n", follower.poses[frame, 2, :3], tracks.points[ids]) + follower.poses[frame, 2, 3]
    sure = (np.einsum("nj,nj->n", rays[first], rays[last]) < np.cos(np.deg2rad(PARALLAX_DEGREES))) & (z > 0)
    frame, pixels, depths, distance = frame[sure], pixels[sure], depths[sure], distance[sure]
    if len(distance) < FEWEST:
        return before
    if before is not None:
        column, row = np.clip(np.round(pixels).astype(int), 0, np.array(cosine.shape[::-1]) - 1).T
        depths = depths / cosine[row, column]
    x, y = (without_means(np.log(values), frame, count) for values in (depths, distance))
    slope, clear = robust_slope(x, y)
    power = slope * (before.power if before else 1.0)
    if not LEAST_POWER < power < MOST_POWER or clear < CLEAR:
        return before
    if before is not None and not before.pixels:
        return replace(before, power=power)
    left = y - slope * x
    at = [np.flatnonzero(frame == f) for f in range(count)]
    middle = before.middle if before else float(np.exp(np.median(np.log(depths))))
    return DepthShape(power, middle, cosine, [pixels[k] for k in at], [left[k] for k in at])


def without_means(values: NDArray, frame: NDArray, count: int) -> NDArray:
    """(N,) values less the mean of their frame: each frame has a scale of its own."""
    total = np.bincount(frame, weights=values, minlength=count) / np.maximum(np.bincount(frame, minlength=count), 1)
    return values - total[frame]


def robust_slope(x: NDArray, y: NDArray) -> tuple[float, float]:
    """Slope of y by x through the origin, with robust weights, and the share of variance that it explains."""
    weight, slope = np.ones_like(x), 1.0
    for _ in range(10):
        slope = float((weight * x * y).sum() / max(float((weight * x * x).sum()), 1e-12))
        error = y - slope * x
        sigma = 1.4826 * float(np.median(np.abs(error))) + 1e-6
        weight = (1 / (1 + (error / (3 * sigma)) ** 2)) ** 2
    return slope, 1 - float((weight * error**2).sum() / max(float((weight * y**2).sum()), 1e-12))
