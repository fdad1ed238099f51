"""Material points carried by the Gaussians: where tissue that is at x now will be, or was, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ..core.types import Camera
from .gaussians import Gaussians
from .scene import Scene, SingleScene, Window

NUM_CARRIERS = 8
"""Gaussians that carry a point."""
TIED_ANEW_PX = 1.0
"""Spread that each further window adds: its Gaussians may be tied to other tissue. Assumed, not measured."""


@dataclass(frozen=True)
class CarriedPoints:
    """P points at T times."""

    positions: NDArray[np.float32]  # (T, P, 3) world, mm
    spread_px: NDArray[np.float64]
    """(T, P) by how much the Gaussians that carry a point disagree about its way since its own frame, px of an image
    640 px wide; of all windows that it passed, added in squares."""


def carry_points(
    scene: Scene, points: NDArray, from_frame: NDArray[np.intp], times: list[float]
) -> NDArray[np.float32]:
    """(T, P, 3) world positions of the points at all times, mm; see `carry`."""
    return carry(scene, points, from_frame, times).positions


def carry(scene: Scene, points: NDArray, from_frame: NDArray[np.intp], times: list[float]) -> CarriedPoints:
    """Move points with the Gaussians around them.

    A point is tied, at the time of its frame, to the 8 nearest Gaussians; it then moves by the mean of their
    displacements, weighted by opacity and by a Gaussian of the distance whose width is the mean distance of the eight.
    In the middle of the overlap of two windows it is tied anew, to Gaussians of the other one.

    Args:
        points: (P, 3) world positions, mm.
        from_frame: (P,) position in `times` at which each point is where `points` says.
        times: T times in [0, 1]; each is seen by the camera of the nearest frame.
    """
    windows, num_frames = scene.windows, len(scene.cameras)
    at = np.asarray(times) * num_frames  # in frames
    borders = [(later.start + earlier.stop - 1) / 2 for earlier, later in pairwise(windows)]
    home = np.searchsorted(borders, at, side="right")  # the window of each time, and of each point
    own = home[from_frame]
    positions = np.empty((len(times), *points.shape), np.float32)
    square = np.empty(positions.shape[:2])  # of the spread
    for onwards in (True, False) if len(windows) > 1 else (True,):
        here, doubt = np.array(points, np.float64), np.zeros(len(points))
        for k in range(home.max() + 1) if onwards else range(len(windows) - 1, home.min() - 1, -1):
            moved = np.flatnonzero(own <= k if onwards else own >= k)
            if not len(moved):
                continue
            asked, ends = np.flatnonzero(home == k), borders[max(k - 1, 0) : k + 1]
            stops = [*at[asked], *ends]  # times within this window, in frames
            enters = len(asked) + (0 if onwards else len(ends) - 1)
            since = np.where(own[moved] == k, np.searchsorted(asked, from_frame[moved]), enters)
            found, added = _carry_in(windows[k], here[moved], since, stops)
            positions[np.ix_(asked, moved)] = found[: len(asked)]
            square[np.ix_(asked, moved)] = doubt[moved] + added[: len(asked)]
            leaves = len(asked) + (len(ends) - 1 if onwards else 0)
            if leaves < len(stops):
                here[moved], doubt[moved] = found[leaves], doubt[moved] + added[leaves] + TIED_ANEW_PX**2
    return CarriedPoints(positions, np.sqrt(square))


def _carry_in(
    window: Window, points: NDArray, from_stop: NDArray[np.intp], stops: list[float]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """(T, P, 3) positions and (T, P) squared spread of their carriers, px squared, within one window.

    Args:
        from_stop: (P,) position in `stops` at which each point is where `points` says.
        stops: T times, in frames of the sequence.
    """
    scene, length = window.scene, window.stop - window.start
    times = [min(max((stop - window.start) / length, 0.0), 1.0) for stop in stops]
    k = min(NUM_CARRIERS, len(scene))
    carriers, distances = np.empty((len(points), k), np.intp), np.empty((len(points), k))
    for start in np.unique(from_stop):
        tied = from_stop == start
        centers = _centers(scene, scene.gaussians, times[start])
        found = KDTree(centers).query(points[tied], k=k, workers=1)
        distances[tied], carriers[tied] = (part.reshape(-1, k) for part in found)
    opacities = scene.gaussians.opacities.detach().cpu().numpy()
    width = np.maximum(distances.mean(1, keepdims=True), 1e-6)
    weights = opacities[carriers] * np.exp(-0.5 * (distances / width) ** 2) + 1e-12
    weights /= weights.sum(1, keepdims=True)
    rows, own = np.unique(carriers, return_inverse=True)  # only those move: few points need few Gaussians
    own = own.reshape(carriers.shape)
    chosen = _taken(scene.gaussians, torch.from_numpy(rows).to(scene.device))
    at_start = np.empty((len(points), k, 3), np.float32)
    for start in np.unique(from_stop):
        tied = from_stop == start
        at_start[tied] = _centers(scene, chosen, times[start])[own[tied]]
    positions = np.empty((len(times), *points.shape), np.float32)
    square = np.empty(positions.shape[:2])
    for i, time in enumerate(times):  # one time after the other: many points at many times fit in memory
        displacements = _centers(scene, chosen, time)[own] - at_start
        mean = np.einsum("pkc,pk->pc", displacements, weights)
        positions[i] = points + mean
        square[i] = _spread_px(displacements - mean[:, None], weights, positions[i], scene.camera_at(time)) ** 2
    return positions, square


def centers_then(scene: Scene, time: float, then: float) -> NDArray[np.float32]:
    """(N, 3) where the Gaussians that `scene` shows at `time` are at the time `then`, world axes, mm."""
    if len(scene.windows) == 1:
        return scene.at(then).means.cpu().numpy()
    centers = scene.at(time).means.cpu().numpy()
    return carry_points(scene, centers, np.zeros(len(centers), np.intp), [time, then])[1]


def _spread_px(deviations: NDArray, weights: NDArray, points: NDArray, camera: Camera) -> NDArray:
    """(P,) standard deviation in the image, px at 640 px width, of (P, K, 3) mm; infinite behind the camera."""
    pose = camera.world_to_camera
    z = points @ pose[2, :3] + pose[2, 3]
    lateral = deviations @ pose[:2, :3].T
    mm = np.sqrt(np.einsum("pkc,pk->p", lateral**2, weights))
    return np.where(z > 0, mm * camera.fx / np.maximum(z, 1e-6), np.inf) * (640 / camera.width)


def _taken(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    return Gaussians({name: value.detach()[rows] for name, value in gaussians.tensors.items()})


@torch.no_grad()
def _centers(scene: SingleScene, gaussians: Gaussians, time: float) -> NDArray[np.float32]:
    """(N, 3) centers of some Gaussians of the scene at a time, mm."""
    return (gaussians["means"] + scene.offsets(gaussians, time).means).cpu().numpy()
