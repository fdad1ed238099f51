"""The scale of relative depth from instruments whose shafts have a known diameter, where their tips touch tissue.

A frame gives the distance of a shaft exactly (`cylinder`), and that of its tip less surely: its axis continues to the
tip, or a wrist bends away from it. With z of the tip in mm, and the relative depth d of the tissue around it,

    log(z / d) = log s - g + e

where s is the scale, g >= 0 says how far, in log depth, the tip is in front of the tissue, and e is an error of known
standard deviation. g has an exponential distribution of unknown mean: in some frames the tip touches tissue, in others
it does not. (s is a "stochastic frontier": W. Meeusen and J. van den Broeck, International Economic Review 1977.) The
median would be too small where tips are off the tissue, the largest value too large where edges are unsure.

A shaft is a cylinder of known radius under perspective; where its axis is follows from the two straight edges of its
image. These are those of the two planes through the camera center that touch it. With inward unit normals n1 and n2 of
the planes, half the angle between the planes, a, has sin(a) = |n1 + n2| / 2. Both planes contain the axis' direction,
which therefore is n1 x n2, and the axis is at distance D = r / sin(a) from the camera center. The formulas are exact; a
cylinder seen from its end has no such edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp

from .shaft_edges import Mask, ShaftEdges, line_through, shafts_of

FLATTEST = 1e-4  # least sin(a): edges nearer to each other, of a shaft 10,000 radii away, give no distance


@dataclass(frozen=True)
class Axis:
    """A straight line in camera axes: x right, y down, z forward."""

    foot_mm: NDArray[np.float64]  # (3,) its point nearest to the camera center
    direction: NDArray[np.float64]  # (3,) unit vector

    @property
    def distance_mm(self) -> float:
        """From the camera center, > 0."""
        return float(np.linalg.norm(self.foot_mm))

    def nearest_to(self, ray: NDArray) -> NDArray[np.float64]:
        """(3,) the point of the axis that is nearest to a ray (3,) from the camera center, mm.

        With unit vectors v of the ray and d of the axis, and the foot p, which is orthogonal to d, it is p + t d at
        t = (p.v)(d.v) / (1 - (d.v)^2). NaN for a ray along the axis.
        """
        unit = ray / np.linalg.norm(ray)
        along = float(self.direction @ unit)
        if 1 - along**2 < FLATTEST**2:
            return np.full(3, np.nan)
        return self.foot_mm + (self.foot_mm @ unit) * along / (1 - along**2) * self.direction


def ray_at(pixel: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray:
    """(3,) direction of a pixel (x, y), with z = 1. `matrix` (3, 3) K, px, in the same coordinates as the pixel."""
    return np.linalg.solve(matrix, np.array([*pixel, 1.0]))


def axis_of(
    lines: NDArray[np.float64], inside: NDArray[np.float64], matrix: NDArray[np.float64], radius_mm: float
) -> Axis | None:
    """The axis of a cylinder from the edges of its image.

    Args:
        lines: (2, 3) a, b, c of the edges, a x + b y + c = 0, px.
        inside: (2,) x, y of a pixel between them.
        matrix: (3, 3) K, px, in the same coordinates.
        radius_mm: of the cylinder, > 0.
    Returns:
        None if the edges are one line, or the pixel is on an edge, or the camera would be in the cylinder.
    """
    normals = lines @ matrix  # of the planes through the camera center: n = K^T l
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    side = normals @ ray_at(inside, matrix)
    if not np.all(np.abs(side) > 0):
        return None
    normals *= np.sign(side)[:, None]
    total, cross = normals.sum(0), np.cross(normals[0], normals[1])
    sine, length = float(np.linalg.norm(total)) / 2, float(np.linalg.norm(cross))
    if not (FLATTEST < sine < 1 and length > FLATTEST):
        return None
    return Axis(radius_mm / sine * total / (2 * sine), cross / length)


EDGE_PX = 1.5  # standard deviation of each end of an edge, at a width of 640 px
AROUND = 0.75  # tissue is compared in this many shaft widths around the tip
MIN_PX = 20  # of tissue with depth there
MAX_STD = 0.35  # of the log distance of a tip: less sure ones say nothing
PLACE = 1 / 32  # of the image width: tips that are nearer to each other are one place, whose readings err alike
FAR_OFF = 0.05  # share of readings that are wrong: another edge, no shaft
WIDE = 4.0  # range of log s in which those are
GAPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3)  # means of g that are tried
SHAPE_STD = 0.06
"""Standard deviation of log relative depth against that of other places: 0.04 to 0.07 for shading."""
COMMON_STD = 0.12
"""Standard deviation of what all readings share: a wrist always bent to one side, shadows beside the shaft."""
STEPS = 2000


@dataclass(frozen=True)
class TipReading:
    """What one frame says of the scale."""

    frame: int
    tip: tuple[float, float]  # x, y, px
    log_ratio: float  # of z of the tip in mm to the relative depth of the tissue around it
    std: float  # of the same, without that of the depth


def tip_readings(
    frame: int,
    tools: Mask,
    outside: Mask,
    rgb_u8: NDArray[np.uint8],
    depth: NDArray[np.float32],
    matrix: NDArray[np.float64],
    radius_mm: float,
) -> list[TipReading]:
    """One reading for each shaft of a frame that is straight and long enough.

    Args:
        tools: (H, W) True on tools; `outside` (H, W) True where the frame shows nothing.
        rgb_u8: (H, W, 3).
        depth: (H, W) relative depth, 0 where missing.
        matrix: (3, 3) K, px, with the left-most pixel centered at 0.5.
    """
    found = []
    for edges in shafts_of(tools, outside, rgb_u8):
        tissue = depth[_near(edges.tip, max(AROUND * edges.width, 6), depth.shape) & ~tools & ~outside & (depth > 0)]
        if tissue.size < MIN_PX or (tip := _tip_depth(edges, matrix, radius_mm)) is None:
            continue
        found.append(TipReading(frame, (*edges.tip,), tip[0] - float(np.log(np.median(tissue))), tip[1]))
    return found


def frontier(readings: Sequence[TipReading], width: int) -> tuple[float, float]:
    """log s and its standard deviation from readings of frames that are `width` px wide.

    Each place of a tip counts once, as a tool at rest errs alike in all frames.
    """
    places: dict[tuple[int, ...], list[TipReading]] = {}
    for reading in readings:
        places.setdefault(tuple(int(v // (PLACE * width)) for v in reading.tip), []).append(reading)
    ratios = np.array([np.median([each.log_ratio for each in group]) for group in places.values()])
    stds = np.hypot([np.median([each.std for each in group]) for group in places.values()], SHAPE_STD)
    grid = np.linspace(ratios.min() - 0.5, ratios.max() + 1.0, STEPS)
    error = ratios - grid[:, None]  # (STEPS, places): e - g
    likelihoods = []
    for gap in GAPS:
        log_density = error / gap + stds**2 / (2 * gap**2) + log_ndtr(-error / stds - stds / gap) - np.log(gap)
        density = np.logaddexp(np.log(1 - FAR_OFF) + log_density, np.log(FAR_OFF / WIDE))
        likelihoods.append(density.sum(1))
    log_posterior = logsumexp(likelihoods, axis=0)
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    mean = float(weight @ grid)
    return mean, float(np.hypot(np.sqrt(weight @ (grid - mean) ** 2), COMMON_STD))


def _tip_depth(edges: ShaftEdges, matrix: NDArray, radius_mm: float) -> tuple[float, float] | None:
    """Log of z of the tip, mm, and its standard deviation; None if it is too unsure.

    It lies between z where the shaft ends (a wrist bent sideways) and z of the axis at the tip (straight): the middle
    is taken, and the standard deviation of a uniform distribution.
    """
    first = _two_depths(edges, edges.ends, matrix, radius_mm)
    if first is None:
        return None
    middle, step = float(np.mean(first)), EDGE_PX * max(matrix[0, 2] / 320, 1.0)
    variance = float(np.ptp(first)) ** 2 / 12
    for edge in range(2):
        for end in range(2):
            moved = edges.ends.copy()
            moved[edge, end] += step * line_through(edges.ends[edge])[:2]
            other = _two_depths(edges, moved, matrix, radius_mm)
            if other is None:
                return None
            variance += (float(np.mean(other)) - middle) ** 2
    return (middle, float(np.sqrt(variance))) if variance <= MAX_STD**2 else None


def _two_depths(edges: ShaftEdges, ends: NDArray, matrix: NDArray, radius_mm: float) -> NDArray | None:
    """(2,) log z of the axis where the shaft ends and at the tip; None behind the camera."""
    axis = axis_of(np.stack([line_through(each) for each in ends]), edges.inside, matrix, radius_mm)
    if axis is None:
        return None
    z = np.array([axis.nearest_to(ray_at(place, matrix))[2] for place in (edges.end, edges.tip)])
    return np.log(z) if np.all(z > 0) else None


def _near(place: NDArray, radius: float, shape: tuple[int, ...]) -> Mask:
    """(H, W) True within a radius of x, y, px."""
    x, y = np.arange(shape[1]) + 0.5 - place[0], np.arange(shape[0]) + 0.5 - place[1]
    return x**2 + y[:, None] ** 2 <= radius**2
