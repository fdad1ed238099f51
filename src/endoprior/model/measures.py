"""Measures of material points over time: distance, path length, area, displacement, stretch of the surface.

Lengths are in the unit of the points: mm, or `rel.` where the scale is unknown. `T` frames, `P` points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..core.geometry import back_project, pixel_centers
from .carry import carry_points
from .scene import Scene
from .surface import render_surface

NUM_NEIGHBORS = 24
"""Surface points around a point that its stretch is fit to."""
SMOOTHING_FRAMES = 5
"""Frames of the moving average before a path length is summed."""
THINNEST = 1e-3
"""A neighborhood says nothing about stretch if its variance across is less than this share of the one along it."""


@dataclass(frozen=True)
class Measures:
    """What is measured of `P` points, in each of `T` frames; NaN where unknown."""

    since: int  # frame that displacement and stretch refer to
    distance: NDArray[np.float64]  # (T,) between the first two points
    area: NDArray[np.float64]  # (T,) of the polygon of all points; NaN where its edges cross
    path_length: NDArray[np.float64]  # (T, P) since frame 0, of the smoothed path
    path_length_raw: NDArray[np.float64]  # (T, P) without smoothing: jitter counts
    displacement: NDArray[np.float64]  # (T, P) distance from the position in frame `since`
    stretch: NDArray[np.float64]  # (T, P) largest principal stretch of the surface around the point; 1: unchanged


def measures_of(paths: NDArray, stretch: NDArray, since: int, drawn: int) -> Measures:
    """Every measure of carried points: paths (T, P, 3), stretch (T, P).

    Args:
        since: frame that displacement refers to. drawn: frame in which the polygon is cut into triangles.
    """
    paths = paths.astype(np.float64)
    unknown = np.full(len(paths), np.nan)
    triangles = polygon_triangles(paths[drawn])
    return Measures(
        since,
        distance(paths[:, 0], paths[:, 1]) if paths.shape[1] > 1 else unknown,
        area(paths, triangles) if len(triangles) else unknown,
        path_length(smoothed(paths)),
        path_length(paths),
        distance(paths, paths[since]),
        stretch,
    )


def distance(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """(...,) distance between points (..., 3)."""
    return np.linalg.norm(a - b, axis=-1)


def path_length(paths: NDArray) -> NDArray[np.float64]:
    """(T, ...) way that points (T, ..., 3) have made since the first frame.

    Jitter only adds: noise of standard deviation s per axis adds 2.3 s in each frame to a point at rest.
    """
    steps = distance(paths[1:], paths[:-1])
    return np.concatenate([np.zeros_like(steps[:1]), np.cumsum(steps, 0)]) if len(steps) else np.zeros(paths.shape[:-1])


def smoothed(paths: NDArray) -> NDArray[np.float64]:
    """(T, ..., 3) the mean over `SMOOTHING_FRAMES` frames around each; fewer at the ends, as many before as after.

    Motion of constant velocity stays as it is; bends become rounder, so their length is a little too small.
    """
    last = len(paths) - 1
    reach = [min(SMOOTHING_FRAMES // 2, i, last - i) for i in range(len(paths))]
    return np.stack([paths[i - r : i + r + 1].mean(0) for i, r in enumerate(reach)])


def area(corners: NDArray, triangles: NDArray[np.intp]) -> NDArray[np.float64]:
    """(T,) summed area of flat triangles (F, 3) between corners (T, P, 3)."""
    a, b, c = (corners[:, triangles[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum(1) / 2


def polygon_triangles(corners: NDArray) -> NDArray[np.intp]:
    """(P - 2, 3) triangles that fill the polygon of the corners (P, 3), in order, by clipping ears in its mean plane.

    (0, 3) for fewer than three corners, unknown ones, and edges that cross.
    """
    none = np.zeros((0, 3), np.intp)
    if len(corners) < 3 or not np.isfinite(corners).all():
        return none
    centered = corners - corners.mean(0)
    # Twice the area vector: the polygon turns positively around it.
    normal = np.cross(centered, np.roll(centered, -1, 0)).sum(0)
    if np.linalg.norm(normal) <= 1e-9 * np.square(centered).sum():
        return none
    along = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    plane = np.stack([along / np.linalg.norm(along), np.cross(normal, along)], 1)
    plane[:, 1] /= np.linalg.norm(plane[:, 1])
    flat = centered @ plane
    if _edges_cross(flat):
        return none
    rest, triangles = list(range(len(flat))), []
    while len(rest) > 3:
        ear = next((i for i in range(len(rest)) if _is_ear(flat, rest, i)), None)
        if ear is None:  # corners on one line
            return none
        triangles.append((rest[ear - 1], rest[ear], rest[(ear + 1) % len(rest)]))
        del rest[ear]
    return np.array([*triangles, tuple(rest)], np.intp)


def neighborhoods(points: NDArray, samples: NDArray) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The surface points around each point.

    Args:
        points: (P, 3). samples: (S, 3) points of the surface, S at least 1.
    Returns:
        (P, K) numbers of the nearest samples, nearest first, and (P,) whether the point is on the surface: the nearest
        sample is no farther from it than its samples scatter.
    """
    k = min(NUM_NEIGHBORS, len(samples))
    far, nearest = KDTree(samples).query(points, k=k, workers=1)
    far, nearest = far.reshape(len(points), k), nearest.reshape(len(points), k)
    around = samples[nearest]
    scatter = np.sqrt(np.square(around - around.mean(1, keepdims=True)).sum(-1).mean(1))
    return nearest, far[:, 0] <= scatter


def principal_stretches(before: NDArray, after: NDArray) -> NDArray[np.float64]:
    """Stretch of pieces of a surface: singular values of the deformation gradient that fits best.

    The tangent plane of a piece is the one through its points before, by least squares. The gradient, a (3, 2) matrix,
    takes positions in this plane to positions after, by least squares. Turning and moving a piece changes nothing,
    bent ones included; scaling it by s gives s.

    Args:
        before, after: (..., K, 3) the same K points.
    Returns:
        (..., 2) largest and smallest: length after over length before, along two perpendicular directions; NaN where a
        point is unknown, or all lie on a line.
    """
    known = np.asarray(np.isfinite(before).all((-2, -1)) & np.isfinite(after).all((-2, -1)))
    before, after = (np.where(known[..., None, None], points, 0.0) for points in (before, after))
    before, after = (points - points.mean(-2, keepdims=True) for points in (before, after))
    variances, axes = np.linalg.eigh(np.swapaxes(before, -1, -2) @ before)  # ascending: the normal comes first
    known = known & (variances[..., 1] > THINNEST * variances[..., 2])
    scale = np.where(known[..., None], variances[..., 1:], 1.0)
    gradient = np.swapaxes(after, -1, -2) @ (before @ axes[..., 1:]) / scale[..., None, :]
    return np.where(known[..., None], np.linalg.svd(gradient, compute_uv=False), np.nan)


def _turn(a: NDArray, b: NDArray, c: NDArray) -> float:
    """Twice the signed area of a flat triangle."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _edges_cross(flat: NDArray) -> bool:
    ends = list(zip(flat, np.roll(flat, -1, 0), strict=True))
    return any(
        _turn(a, b, c) * _turn(a, b, d) < 0 and _turn(c, d, a) * _turn(c, d, b) < 0
        for i, (a, b) in enumerate(ends)
        for c, d in ends[:i]
    )


def _is_ear(flat: NDArray, rest: list[int], i: int) -> bool:
    """Whether the corner turns outward and its triangle holds no other corner."""
    own = rest[i - 1], rest[i], rest[(i + 1) % len(rest)]
    a, b, c = (flat[k] for k in own)
    if _turn(a, b, c) <= 0:
        return False
    others = (flat[k] for k in rest if k not in own)
    return not any(min(_turn(a, b, p), _turn(b, c, p), _turn(c, a, p)) >= 0 for p in others)


SAMPLE_COLUMNS = 40
"""Surface points along a row of the image. Stretch is fit to 24 of them, so over about 14 % of the image's width: over
less, errors of the tracks show as stretch; over more, real differences blur."""


class SurfaceMotion:
    """The surface that the camera of one frame sees, and its stretch since then."""

    def __init__(self, scene: Scene, since: int, min_alpha: float = 0.5) -> None:
        """Render the surface of frame `since`, and sample it on a grid."""
        self._scene, self.since = scene, since
        surface = render_surface(scene, self._time(since), scene.cameras[since], min_alpha)
        step = max(surface.camera.width // SAMPLE_COLUMNS, 1)
        depth = surface.depth[step // 2 :: step, step // 2 :: step]
        pixels = pixel_centers(surface.camera.width, surface.camera.height)[step // 2 :: step, step // 2 :: step]
        seen = depth > 0
        self.samples = back_project(pixels[seen].astype(np.float64), depth[seen].astype(np.float64), surface.camera)
        """(S, 3) points of the surface in that frame, world axes, mm."""

    def _time(self, frame: int) -> float:
        return frame / len(self._scene.cameras)

    def stretch(self, points: NDArray, frames: list[int]) -> NDArray[np.float64]:
        """(F, P) largest principal stretch, in each of `frames`, around points (P, 3), mm, of the surface's frame.

        1: unchanged; NaN for points that are not on the surface.
        """
        found = np.full((len(frames), len(points)), np.nan)
        on_surface = np.asarray(np.isfinite(points).all(1))
        if not len(self.samples) or not on_surface.any():
            return found
        nearest, around = neighborhoods(points[on_surface], self.samples)
        used, places = np.unique(nearest[around], return_inverse=True)
        on_surface[on_surface] = around
        if not len(used):
            return found
        before = self.samples[used]
        times = [self._time(frame) for frame in (self.since, *frames)]
        moved = carry_points(self._scene, before, np.zeros(len(used), np.intp), times)[1:].astype(np.float64)
        places = places.reshape(-1, nearest.shape[1])
        for found_there, after in zip(found, moved, strict=True):
            found_there[on_surface] = principal_stretches(before[places], after[places])[:, 0]
        return found
