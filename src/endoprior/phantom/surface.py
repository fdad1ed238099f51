"""The anatomy at rest: bowel loops, folded mesentery and a liver edge, as heights over a tilted plane.

Letters: (g_u, g_v) in [0, 1] are material grid coordinates, uniform in the image of the plane at rest and larger than
the image, or uniform on the plane where the camera moves; (a, b) are metric coordinates on the plane, mm (a right, b
towards the lower image edge); heights are mm along the plane's normal, towards the camera. Axes are those of the left
camera in the first frame, OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import REORDERED
from .config import PhantomConfig
from .noise import fractal

MARGIN = 0.27
"""Margin of the material around the image, in image sizes, so that no motion uncovers its border."""
FLOOR, LIVER = -1, -2
"""Owners that are not loops."""
_LOOP_POINTS = 36
_MM2_PER_LOOP = 740.0
_RIM = 0.94
"""Distance from a loop's axis, in radii, where its round profile turns into a straight skirt."""


@dataclass(frozen=True)
class Plane:
    """The tilted plane that carries the anatomy."""

    origin: NDArray[np.float64]
    """(3,) point on the optical axis, mm."""
    axes: NDArray[np.float64]
    """(3, 3) rows e_a, e_b, normal (towards the camera), orthonormal."""
    window: tuple[float, float, float, float]
    """Range (x0, x1, y0, y1) that g_u, g_v in [0, 1] span: of X/Z and Y/Z, or of a and b in mm if `metric`."""
    metric: bool = False
    """Whether the grid is uniform on the plane, as for a camera that moves, and not in the first image."""

    def coordinates(self, grid_u: NDArray, grid_v: NDArray) -> tuple[NDArray, NDArray]:
        """(a, b) in mm where the viewing ray of (g_u, g_v) meets the plane."""
        x0, x1, y0, y1 = self.window
        across, down = np.broadcast_arrays(x0 + (x1 - x0) * grid_u, y0 + (y1 - y0) * grid_v)
        if self.metric:
            return across, down
        rays = np.stack(np.broadcast_arrays(across, down, 1.0), -1)
        normal = self.axes[2]
        offset = rays * ((self.origin @ normal) / (rays @ normal))[..., None] - self.origin
        return offset @ self.axes[0], offset @ self.axes[1]

    def lift(self, a: NDArray, b: NDArray, height: NDArray) -> NDArray:
        """(..., 3) camera-space point at plane coordinates (a, b) and `height`, mm."""
        return self.origin + np.stack(np.broadcast_arrays(a, b, height), -1) @ self.axes

    def grid(self, a: NDArray, b: NDArray) -> tuple[NDArray, NDArray]:
        """(g_u, g_v) of plane points: the inverse of `coordinates`."""
        x0, x1, y0, y1 = self.window
        if self.metric:
            return (a - x0) / (x1 - x0), (b - y0) / (y1 - y0)
        point = self.lift(a, b, np.zeros(()))
        return (point[..., 0] / point[..., 2] - x0) / (x1 - x0), (point[..., 1] / point[..., 2] - y0) / (y1 - y0)


@dataclass(frozen=True)
class Anatomy:
    """Layout of the organs on the plane."""

    seed: int
    paths: NDArray[np.float32]
    """(K, M, 2) axes of the loops as polylines in (a, b), mm; loop 0 is the one the grasper takes."""
    radii: NDArray[np.float32]
    bases: NDArray[np.float32]
    """(K, M) radius along each loop, and height of its axis, mm; both ends dive under the neighbors."""
    liver_edge: NDArray[np.float64]
    """(4,) level, slope, bend amplitude and phase of the liver's edge b(a)."""


@dataclass(frozen=True)
class Organs:
    """Height above the plane, mm, and organ (a loop's index, FLOOR or LIVER) at each queried plane point."""

    height: NDArray[np.float32]
    owner: NDArray[np.int32]
    along: NDArray[np.float32]
    across: NDArray[np.float32]
    """Arc length along a loop, and signed distance from its axis, mm; 0 elsewhere."""


def build_plane(cfg: PhantomConfig) -> Plane:
    """The plane seen by the configured camera: 78-88 mm away on the axis, receding towards the upper image edge."""
    rng = np.random.default_rng([cfg.seed, 1])
    tilt = np.array([rng.uniform(-0.14, 0.14), rng.uniform(0.34, 0.46)])
    normal = np.array([-tilt[0], -tilt[1], -1.0]) / np.sqrt(1 + tilt @ tilt)
    e_a = np.array([1.0, 0, 0]) - normal[0] * normal
    e_a /= np.linalg.norm(e_a)
    (cx, cy), pad_x, pad_y = cfg.center, MARGIN * cfg.width, MARGIN * cfg.height
    window = (-(cx + pad_x) / cfg.focal, (cfg.width + pad_x - cx) / cfg.focal)
    window += (-(cy + pad_y) / cfg.focal, (cfg.height + pad_y - cy) / cfg.focal)
    origin = np.array([0, 0, rng.uniform(78, 88)])
    axes = np.stack([e_a, np.cross(e_a, normal), normal]).astype(np.float64)
    return Plane(origin, axes, window)


def build_anatomy(seed: int, wider: tuple[float, float, float, float] | None = None) -> Anatomy:
    """Choose the organs of one patient.

    Args:
        wider: range (a0, a1, b0, b1), mm, to fill with further loops; those in the middle are the same without it.
    """
    rng = np.random.default_rng([seed, 2])
    # The main loop crosses the center of the image: arching or sagging, from either side, slightly rotated.
    side, sag = rng.choice([-1.0, 1.0]), rng.uniform(-6, 14)
    knots = np.array([[-58, 34], [-40, 14], [-25, 2], [-4, -5], [20, -6], [32, 8], [26, 28], [14, 44]], float)
    knots = (knots + rng.normal(0, 3, knots.shape)) * [side, 1.0]
    knots[:, 1] += sag * (knots[:, 0] / 40) ** 2
    knots[:, 1] *= rng.choice([-1.0, 1.0], p=[0.4, 0.6])
    roll = rng.uniform(-0.45, 0.35) * side
    knots = knots @ np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    loops, sizes, heights = [knots], [rng.uniform(11.0, 13.5)], [1.5]
    _add_loops(rng, 26, (-78, -62), (78, 62), loops, sizes, heights)
    steps = np.linspace(0, 1, _LOOP_POINTS)
    waves = _waves(rng, len(loops), steps)
    edge = np.array([rng.uniform(-33, -27), rng.uniform(-0.22, 0.22), rng.uniform(2, 5), rng.uniform(0, 6.3)])
    if wider is not None:
        # As many to a square mm as in the middle; under the liver there are none to be seen.
        a0, a1, b0, b1 = wider
        b0 = max(b0, edge[0] - 30)
        more = max(0, round((a1 - a0) * (b1 - b0) / _MM2_PER_LOOP) - len(loops))
        _add_loops(rng, more, (a0, b0), (a1, b1), loops, sizes, heights)
        waves += _waves(rng, more, steps)
    paths = np.stack([_spline(loop, _LOOP_POINTS) for loop in loops])
    radii = np.array(sizes)[:, None] * np.array(waves)
    dive = np.clip(1 - np.minimum(steps, 1 - steps) / 0.24, 0, 1) ** 2
    bases = np.array(heights)[:, None] - radii[:, :1] * 0.9 * dive
    paths, radii, bases = (np.ascontiguousarray(values, np.float32) for values in (paths, radii, bases))
    return Anatomy(seed, paths, radii, bases, edge)


def _add_loops(
    rng: np.random.Generator,
    count: int,
    low: tuple[float, float],
    high: tuple[float, float],
    loops: list[NDArray],
    sizes: list[float],
    heights: list[float],
) -> None:
    """Append knots, radius and height of loops, each in the emptiest place between `low` and `high` (a, b), mm."""
    for _ in range(count):
        candidates = rng.uniform(low, high, (40, 2))
        bare = np.linalg.norm(candidates[:, None] - np.concatenate(loops), axis=-1).min(1)
        center, angle, turn = candidates[bare.argmax()], rng.uniform(0, np.pi), rng.uniform(-1.3, 1.3)
        reach = np.linspace(-1, 1, 6) * rng.uniform(18, 34)
        heading = angle + turn * np.linspace(-1, 1, 6)
        loops.append(center + reach[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1))
        sizes.append(rng.uniform(7.0, 11.5))
        heights.append(rng.uniform(-5.5, 0.0))


def _waves(rng: np.random.Generator, count: int, steps: NDArray) -> list[NDArray]:
    """How the radius of each of `count` loops varies along it, about 1."""
    return [1 + 0.05 * np.sin(2 * np.pi * (rng.uniform(3, 5) * steps + rng.uniform())) for _ in range(count)]


def _spline(knots: NDArray, count: int) -> NDArray:
    """(count, 2) points, equally far apart, on the uniform cubic B-spline of `knots` (n, 2), ends repeated."""
    knots = np.concatenate([knots[:1], knots[:1], knots, knots[-1:], knots[-1:]])
    t = np.linspace(0, len(knots) - 3 - 1e-9, 8 * count)
    k, f = t.astype(int), (t % 1)[:, None]
    weights = ((1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3)
    curve = np.sum([w * knots[k + i] for i, w in enumerate(weights)], 0) / 6
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    even = np.linspace(0, arc[-1], count)
    return np.stack([np.interp(even, arc, curve[:, i]) for i in range(2)], -1)


@parallel_njit(fastmath=REORDERED)
def _loops(a, b, paths, radii, bases, boxes, height, owner, along, across):
    # One task per row of a, b (H, W). Highest loop at each point; ties go to the lower index. boxes (K, 4) are a0, a1,
    # b0, b1 outside which a loop lies under the floor. Writes the last four arrays.
    rim = np.float32(_RIM)
    rim_height = np.sqrt(np.float32(1) - rim * rim)
    rim_slope = rim / rim_height
    for i in prange(a.shape[0]):
        for j in range(a.shape[1]):
            best = np.float32(-60)
            for k in range(paths.shape[0]):
                if a[i, j] < boxes[k, 0] or a[i, j] > boxes[k, 1] or b[i, j] < boxes[k, 2] or b[i, j] > boxes[k, 3]:
                    continue
                near, radius, base = np.float32(1e9), np.float32(1), np.float32(0)
                arc, sign, length = np.float32(0), np.float32(1), np.float32(0)
                for m in range(paths.shape[1] - 1):
                    px, py = paths[k, m, 0], paths[k, m, 1]
                    ex, ey = paths[k, m + 1, 0] - px, paths[k, m + 1, 1] - py
                    qx, qy = a[i, j] - px, b[i, j] - py
                    square = ex * ex + ey * ey
                    f = min(max((qx * ex + qy * ey) / square, np.float32(0)), np.float32(1))
                    rx, ry = qx - f * ex, qy - f * ey
                    distance = rx * rx + ry * ry
                    step = np.sqrt(square)
                    if distance < near:
                        near = distance
                        radius = radii[k, m] + f * (radii[k, m + 1] - radii[k, m])
                        base = bases[k, m] + f * (bases[k, m + 1] - bases[k, m])
                        arc = length + f * step
                        sign = np.float32(1) if ex * ry - ey * rx > 0 else np.float32(-1)
                    length += step
                distance = np.sqrt(near)
                q = distance / radius
                if q < rim:
                    profile = np.sqrt(np.float32(1) - q * q)
                else:
                    profile = rim_height - rim_slope * (q - rim)
                value = base + np.float32(0.9) * radius * profile
                if value > best:
                    best = value
                    owner[i, j], along[i, j], across[i, j] = k, arc, sign * distance
            height[i, j] = best


def organs_at(anatomy: Anatomy, a: NDArray, b: NDArray) -> Organs:
    """Look up height and ownership at plane points `a, b` (H, W), mm."""
    a, b = a.astype(np.float32), b.astype(np.float32)
    height, along, across = (np.zeros(a.shape, np.float32) for _ in range(3))
    owner = np.zeros(a.shape, np.int32)
    reach = 1.5 * anatomy.radii.max(1, keepdims=True)
    low, high = anatomy.paths.min(1) - reach, anatomy.paths.max(1) + reach
    boxes = np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], -1).astype(np.float32)
    _loops(a, b, anatomy.paths, anatomy.radii, anatomy.bases, boxes, height, owner, along, across)
    seed = anatomy.seed
    folds = fractal(a / 7 + fractal(a / 16, b / 16, 1, seed + 11), b / 11, 2, seed + 12)
    floor = -5.5 + 3.0 * fractal(a / 26, b / 26, 2, seed + 10) + 1.3 * (1 - 2 * np.abs(folds))
    liver = _liver_height(anatomy, a, b)
    owner = np.where(floor > height, FLOOR, owner)
    height = np.maximum(height, floor)
    owner = np.where(liver > height, LIVER, owner).astype(np.int32)
    height = np.maximum(height, liver)
    on_loop = owner >= 0
    return Organs(height, owner, np.where(on_loop, along, 0), np.where(on_loop, across, 0))


def _liver_height(anatomy: Anatomy, a: NDArray, b: NDArray) -> NDArray[np.float32]:
    """Height of the liver's lower edge: a rounded lip, a slow dome behind it, a steep skirt in front of it."""
    level, slope, bend, phase = anatomy.liver_edge
    inside = level + slope * a + bend * np.sin(a / 17 + phase) + 1.2 * np.sin(a / 6.5 - phase) - b
    q = np.clip(inside / 9, 0, 1)
    lip = np.sqrt(np.maximum(1 - (1 - np.maximum(q, 0.03)) ** 2, 0))
    skirt = np.minimum(inside - 0.27, 0) * 2.6
    return (4.5 + 7.5 * lip + 0.05 * np.maximum(inside - 9, 0) + skirt).astype(np.float32)


def soften(values: NDArray, spacing_mm: float, radius_mm: float) -> NDArray:
    """Gaussian blur of a map whose samples lie about `spacing_mm` apart; sigma = `radius_mm`."""
    return cv2.GaussianBlur(values, (0, 0), max(radius_mm / spacing_mm, 0.3), borderType=cv2.BORDER_REPLICATE)
