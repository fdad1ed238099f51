"""Measure the rim of a round border: lit ring, blur and fall-off that show the lens and no tissue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .dark_outline import Darkness
from .radial import Edges, profiles

LEAST_SHARE, LEAST_PX = 0.005, 1.0
"""Smallest rim, in radii and px."""
MOST_SHARE = 0.06
"""Largest rim, in radii."""
TISSUE = (0.06, 0.12)
"""Depths, in radii, that show tissue in all endoscopes."""
RADIAL = 1.6
"""In a rim the level changes this many times more across the border than deeper in the image."""
FADED = 0.7
"""A rim is darker than this share of the level that tissue's own fall-off leads to."""


def measure_rim(grays: Sequence[NDArray[np.uint8]], edges: Edges, darkness: Darkness) -> float:
    """Width of the rim, px inside of the radius.

    Tissue moves and its structures have any direction. A rim stays, is lit or faded, and changes across the border:
    the rim ends at the last depth where levels change much more across the border than along it, or are faded.
    """
    depths = np.arange(0.0, TISSUE[1] * edges.radius, 0.5)
    circles = [edges.circle(k) for k in range(len(grays))]
    levels = profiles(grays, circles, edges.angles, depths) - darkness.level
    rows = levels[edges.hits]
    rows = rows[np.isfinite(rows).all(1)]
    least = max(LEAST_SHARE * edges.radius, LEAST_PX)
    tissue = depths >= TISSUE[0] * edges.radius
    normal = rows[:, tissue].mean(1)
    lit = normal > 2 * darkness.step
    if lit.sum() < 20:
        return least
    share = rows[lit] / normal[lit, None]
    across = np.abs(share[:, 2:] - share[:, :-2])
    change = np.median(across, axis=0)
    usual = np.median(change[tissue[1:-1]]) + 0.02
    level = np.median(share, axis=0)
    is_rim = (level < FADED) | (level > 1 / FADED)
    is_rim[1:-1] |= change > RADIAL * usual
    is_rim &= depths < MOST_SHARE * edges.radius
    last = float(depths[np.flatnonzero(is_rim)[-1]] + 1) if is_rim.any() else 0.0
    return float(np.clip(last, least, MOST_SHARE * edges.radius))
