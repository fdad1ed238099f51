"""Measures of material points over time: distance, path length, area, displacement, stretch of the surface.

Lengths are in the unit of the points: mm, or `rel.` where the scale is unknown. `T` frames, `P` points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..core.geometry import Strain, back_project, pixel_centers, strain_of, unit_vectors
from ..core.types import Camera
from .carry import carry_points
from .scene import Scene
from .surface import render_surface
from .uncertainty import PointErrors

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
    ranges: Ranges | None = None  # None: the errors of the points are not known


@dataclass(frozen=True)
class Ranges:
    """Half of the range around each measure that holds 95 % of the true values: see `uncertainty`."""

    distance: NDArray[np.float64]  # (T,)
    area: NDArray[np.float64]  # (T,)
    displacement: NDArray[np.float64]  # (T, P)


def measures_of(
    paths: NDArray, stretch: NDArray, since: int, drawn: int, errors: PointErrors | None = None
) -> Measures:
    """Every measure of carried points: paths (T, P, 3), stretch (T, P).

    Args:
        since: frame that displacement refers to. drawn: frame in which the polygon is cut into triangles.
        errors: of the points, for the ranges.
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
        None if errors is None else ranges_of(paths, since, triangles, errors),
    )


def ranges_of(paths: NDArray, since: int, triangles: NDArray[np.intp], errors: PointErrors) -> Ranges:
    """To first order in the errors of the points (T, P, 3), which are independent of each other."""
    unknown = np.full(len(paths), np.nan)
    ends = np.zeros_like(paths)
    if paths.shape[1] > 1:
        ends[:, 0] = unit_vectors(paths[:, 0] - paths[:, 1])
        ends[:, 1] = -ends[:, 0]
    way = unit_vectors(paths - paths[since])
    now, then = (each.half_width(way, since_pick=True) for each in (errors, errors.at(slice(since, since + 1))))
    return Ranges(
        np.sqrt(np.square(errors.half_width(ends)).sum(1)) if paths.shape[1] > 1 else unknown,
        np.sqrt(np.square(errors.half_width(area_gradient(paths, triangles))).sum(1)) if len(triangles) else unknown,
        np.hypot(now, then),
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


def area_gradient(corners: NDArray, triangles: NDArray[np.intp]) -> NDArray[np.float64]:
    """(T, P, 3) by how much `area` grows as each corner moves."""
    found = np.zeros(corners.shape)
    for a, b, c in (np.roll(triangles, -k, 1).T for k in range(3)):
        normal = unit_vectors(np.cross(corners[:, b] - corners[:, a], corners[:, c] - corners[:, a]))
        pushes = np.cross(normal, corners[:, c] - corners[:, b]) / 2
        for k, corner in enumerate(a):
            found[:, corner] += pushes[:, k]
    return found


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


def fitted_strain(before: NDArray, after: NDArray) -> Strain:
    """Strain of pieces of a surface: that of the deformation gradient that fits best.

    The tangent plane of a piece is the one through its points before, by least squares. The gradient, a (3, 2) matrix,
    takes positions in this plane to positions after, by least squares. Turning and moving a piece changes nothing,
    bent ones included; scaling it by s gives s.

    Args:
        before, after: (..., K, 3) the same K points.
    Returns:
        NaN where a point is unknown, or all lie on a line.
    """
    known = np.asarray(np.isfinite(before).all((-2, -1)) & np.isfinite(after).all((-2, -1)))
    before, after = (np.where(known[..., None, None], points, 0.0) for points in (before, after))
    before, after = (points - points.mean(-2, keepdims=True) for points in (before, after))
    variances, axes = np.linalg.eigh(np.swapaxes(before, -1, -2) @ before)  # ascending: the normal comes first
    known = known & (variances[..., 1] > THINNEST * variances[..., 2])
    scale = np.where(known[..., None], variances[..., 1:], 1.0)
    gradient = np.swapaxes(after, -1, -2) @ (before @ axes[..., 1:]) / scale[..., None, :]
    strain = strain_of(gradient, axes[..., 1:])
    return Strain(*(np.where(known[..., None], values, np.nan) for values in strain))


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
        surface = render_surface(scene, self._scene.frame_time(since), scene.cameras[since], min_alpha)
        self.samples = surface_samples(surface.depth, surface.camera)
        """(S, 3) points of the surface in that frame, world axes, mm."""

    def stretch(self, points: NDArray, frames: list[int]) -> NDArray[np.float64]:
        """(F, P) largest principal stretch of `strain`."""
        return self.strain(points, frames).stretch[..., 0]

    def strain(self, points: NDArray, frames: list[int]) -> Strain:
        """(F, P) strain, in each of `frames`, around points (P, 3), mm, of the surface's frame; world axes.

        NaN for points that are not on the surface.
        """

        def carried(samples: NDArray) -> NDArray:
            times = [self._scene.frame_time(frame) for frame in (self.since, *frames)]
            return carry_points(self._scene, samples, np.zeros(len(samples), np.intp), times)[1:]

        return strain_around(points, self.samples, len(frames), carried)


def strain_around(points: NDArray, samples: NDArray, count: int, carried: Callable[[NDArray], NDArray]) -> Strain:
    """(F, P) strain around points (P, 3) at F = `count` times; NaN for points that are not on the surface.

    Args:
        samples: (S, 3) points of the surface. carried: gives the positions (F, N, 3) at these times of N of them.
    """
    found = Strain(np.full((count, len(points), 2), np.nan), np.full((count, len(points), 3), np.nan))
    on_surface = np.asarray(np.isfinite(points).all(1))
    if not len(samples) or not on_surface.any():
        return found
    nearest, around = neighborhoods(points[on_surface], samples)
    used, places = np.unique(nearest[around], return_inverse=True)
    on_surface[on_surface] = around
    if not len(used):
        return found
    before, places = samples[used], places.reshape(-1, nearest.shape[1])
    for k, after in enumerate(carried(before).astype(np.float64)):
        strain = fitted_strain(before[places], after[places])
        found.stretch[k, on_surface], found.direction[k, on_surface] = strain
    return found


def surface_samples(depth: NDArray, camera: Camera) -> NDArray[np.float64]:
    """(S, 3) points of the surface that a camera sees, on a grid; depth (H, W) z, mm, 0 where unknown. World axes."""
    step = max(camera.width // SAMPLE_COLUMNS, 1)
    depth = depth[step // 2 :: step, step // 2 :: step]
    pixels = pixel_centers(camera.width, camera.height)[step // 2 :: step, step // 2 :: step]
    seen = depth > 0
    return back_project(pixels[seen].astype(np.float64), depth[seen].astype(np.float64), camera)
