"""Which other frames measure the depth of a frame: those that see the same tissue from another side, and soon.

Parallax is the angle between the rays of two cameras to one point. Little of it measures poorly; much of it changes how
tissue looks; and the longer the time between two frames, the further tissue has moved by itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

MIN_DEGREES, WANTED_DEGREES, MAX_DEGREES = 2.0, 5.0, 12.0
"""Median parallax below which a frame is no partner, at which the first one in time is taken, above which none is."""
SECOND = 0.6  # share of `WANTED_DEGREES` of the second partner on each side: it tells motion of tissue from depth
REACH = 60  # frames on each side in which partners are searched
OVERLAP = 0.5  # least share of probed points that a partner sees
PROBES = (-0.6, 0.0, 0.6)  # places of the probed points, as shares of half the width and of half the height


def choose_partners(
    world_to_camera: NDArray[np.float64],
    matrix: NDArray[np.float64],
    size: tuple[int, int],
    distance: NDArray[np.float64],
    usable: NDArray[np.bool_],
) -> list[tuple[int, ...]]:
    """Up to four partners of each frame, two before and two after it; none where the camera moves too little.

    Args:
        world_to_camera: (T, 4, 4). matrix: (3, 3) K, px. size: (width, height), px.
        distance: (T,) of the tissue that a frame sees, in the unit of the poses.
        usable: (T,) whether a frame has a pose of its own and shows tissue.
    """
    count = len(world_to_camera)
    return [
        _partners(i, world_to_camera, matrix, size, float(distance[i]), usable) if usable[i] else ()
        for i in range(count)
    ]


def _partners(
    i: int, poses: NDArray, matrix: NDArray, size: tuple[int, int], distance: float, usable: NDArray
) -> tuple[int, ...]:
    found: list[int] = []
    for side in (range(i - 1, max(i - 1 - REACH, -1), -1), range(i + 1, min(i + 1 + REACH, len(poses)))):
        others = [j for j in side if usable[j]]
        degrees = dict(zip(others, parallax(poses, i, others, matrix, size, distance), strict=True))
        fit = [j for j in others if MIN_DEGREES <= degrees[j] <= MAX_DEGREES]
        if not fit:
            continue
        first = next((j for j in fit if degrees[j] >= WANTED_DEGREES), max(fit, key=lambda j: degrees[j]))
        found.append(first)
        if rest := [j for j in fit if j != first]:
            found.append(min(rest, key=lambda j: abs(degrees[j] - SECOND * WANTED_DEGREES)))
    return tuple(found)


def parallax(
    poses: NDArray[np.float64],
    i: int,
    others: Sequence[int],
    matrix: NDArray[np.float64],
    size: tuple[int, int],
    distance: float,
) -> NDArray[np.float64]:
    """(len(others),) median parallax of frame i with other frames, degrees; 0 where they see too little of it.

    It is that of points spread over the image, not of its middle alone: a camera that drives ahead has none there.

    Args:
        poses: (T, 4, 4) world to camera. distance: of the tissue from frame i.
    """
    x, y = (side / 2 * np.array(PROBES) for side in size)
    pixels = np.stack([*np.meshgrid(x + matrix[0, 2], y + matrix[1, 2]), np.ones((len(x), len(y)))], -1).reshape(-1, 3)
    points = pixels @ np.linalg.inv(matrix).T * distance
    turn, shift = poses[i, :3, :3], poses[i, :3, 3]
    world = (points - shift) @ turn  # R^T (p - t)
    here = world - _center(poses[i])
    out = np.zeros(len(others))
    for k, j in enumerate(others):
        seen = world @ poses[j, :3, :3].T + poses[j, :3, 3]
        image = seen @ matrix.T
        uv = image[:, :2] / np.maximum(image[:, 2:], 1e-9)
        inside = (seen[:, 2] > 0) & ((uv >= 0) & (uv < np.array(size))).all(1)
        if inside.mean() < OVERLAP:
            continue
        there = world - _center(poses[j])
        cosine = (here * there).sum(1) / (np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1))
        out[k] = np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))[inside]))
    return out


def _center(world_to_camera: NDArray) -> NDArray:
    return -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
