"""The scale of relative depth from instruments whose shafts have a known diameter, where their tips touch tissue.

A frame gives the distance of a shaft exactly (`cylinder`), and that of its tip less surely: its axis continues to the
tip, or a wrist bends away from it. With z of the tip in mm, and the relative depth d of the tissue around it,

    log(z / d) = log s - g + e

where s is the scale, g >= 0 says how far, in log depth, the tip is in front of the tissue, and e is an error of known
standard deviation. g has an exponential distribution of unknown mean: in some frames the tip touches tissue, in others
it does not. (s is a "stochastic frontier": W. Meeusen and J. van den Broeck, International Economic Review 1977.) The
median would be too small where tips are off the tissue, the largest value too large where edges are unsure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp

from .cylinder import axis_of, ray_at
from .shaft_edges import Mask, ShaftEdges, line_through, shafts_of

EDGE_PX = 1.5  # standard deviation of each end of an edge, at a width of 640 px
AROUND = 0.75  # tissue is compared in this many shaft widths around the tip
FEWEST_PX = 20  # of tissue with depth there
MOST_STD = 0.35  # of the log distance of a tip: less sure ones say nothing
PLACE = 1 / 32  # of the image width: tips that are nearer to each other are one place, whose readings err alike
FAR_OFF = 0.05  # share of readings that are wrong: another edge, no shaft
WIDE = 4.0  # range of log s in which those are
GAPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3)  # means of g that are tried
SHAPE_STD = 0.06
"""Standard deviation of log relative depth against that of other places: 0.04 to 0.07 for shading (docs/prepare.md)."""
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
        if tissue.size < FEWEST_PX or (tip := _tip_depth(edges, matrix, radius_mm)) is None:
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
    return (middle, float(np.sqrt(variance))) if variance <= MOST_STD**2 else None


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
