"""Tissue that moves by a stated law: a neo-Hookean sheet on an elastic bed, pulled, poked or carried by breathing.

The upper face of the sheet is the anatomy, smoothed; what is finer moves with it. It is always in equilibrium
(quasi-static). Loads grow by one factor from 0 to 1, `strength`: equilibria are solved at load steps, and a cubic
spline lies between them. Letters: (a, b) and heights as in `surface`; a grid of (GH, GW) vertices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RectBivariateSpline

from .sheet import Sheet, offset
from .surface import Anatomy, organs_at, soften

THICKNESS_MM = 3.0
BED_MM = 25.0
"""Distance within which the bed takes up a displacement in the plane: its stiffness is 4 t / BED_MM^2."""
_HALF_MM = (80.0, 64.0)
"""Half the sides of the sheet, along a and b. Its border moves with the bed."""
_SPACING_MM = 3.2
"""With half of it, displacements by a pull of 12 mm differ by 0.03 mm on average, and stretches by 0.003."""
_SMOOTH_MM = 4.0
"""The sheet follows the anatomy without creases."""
_STEPS = 8
"""Load steps."""
GRIP_MM = 8.0
"""Standard deviation of the stiffness of the springs by which a tool holds the tissue."""
_GRIP = 30.0
"""Their stiffness at the middle, relative to that of the bed."""
GROWTH_PER_MM = 1 / 75
"""Expansion of the bed for each mm of `breathing_mm`: tissue 75 mm from the middle moves as far as it rises."""


@dataclass(frozen=True)
class MovingSheet:
    """The displacement of one load at every strength."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    """(GW,) and (GH,) coordinates of the grid, mm."""
    beyond_bed: CubicSpline
    """Strength -> (GH, GW, 3) displacement of the upper face, less that of the bed."""
    rise: float
    growth: float
    """How far the bed rises, mm, and by which share it expands about (0, 0), at strength 1."""

    def displacement(self, a: NDArray, b: NDArray, strength: float) -> NDArray[np.float64]:
        """(..., 3) along e_a, e_b and the normal, mm, at plane points (a, b)."""
        grid, (low_a, high_a), (low_b, high_b) = self.beyond_bed(strength), self.a[[0, -1]], self.b[[0, -1]]
        at = np.clip(b, low_b, high_b), np.clip(a, low_a, high_a)
        moved = np.stack([RectBivariateSpline(self.b, self.a, grid[..., k]).ev(*at) for k in range(3)], -1)
        return moved + strength * _bed(a, b, self.rise, self.growth)


@dataclass(frozen=True)
class Load:
    """What moves the tissue, and when."""

    sheet: MovingSheet
    strength: Callable[[float], float]
    """0..1 at a time in [0, 1]."""


def _bed(a: NDArray, b: NDArray, rise: float, growth: float) -> NDArray[np.float64]:
    """(..., 3) displacement of the bed, mm."""
    return np.stack(np.broadcast_arrays(growth * a, growth * b, rise), -1)


def solve_sheet(
    anatomy: Anatomy, center: NDArray, vector: NDArray, rise: float, growth: float, spacing: float = _SPACING_MM
) -> MovingSheet:
    """Solve one load.

    Args:
        center: (2,) plane point that a tool holds.
        vector: (3,) where it takes it at strength 1, mm; 0: it holds nothing.
        rise, growth: see `MovingSheet`. spacing: of the grid, mm.
    """
    a, b = (np.linspace(-half, half, 2 * round(half / spacing) + 1) for half in _HALF_MM)
    grid_b, grid_a = np.meshgrid(b, a, indexing="ij")
    height = soften(organs_at(anatomy, grid_a, grid_b).height.astype(np.float64), spacing, _SMOOTH_MM)
    face = np.stack([grid_a, grid_b, height], -1)
    middle = offset(face, -THICKNESS_MM / 2)
    sheet = Sheet(middle, (b[1] - b[0], a[1] - a[0]), THICKNESS_MM)
    bed = 4 * THICKNESS_MM / BED_MM**2
    square = (grid_a - center[0]) ** 2 + (grid_b - center[1]) ** 2
    held = (_GRIP * bed if np.any(vector) else 0.0) * np.exp(-square / (2 * GRIP_MM**2)).reshape(-1, 1)
    carried = _bed(grid_a, grid_b, rise, growth).reshape(-1, 3)
    target = (bed * carried + held * (carried + vector)) / (bed + held)
    fixed = np.ones(face.shape, bool)
    fixed[1:-1, 1:-1] = False
    strengths, moved, found = np.linspace(0, 1, _STEPS + 1), np.zeros_like(target), [np.zeros_like(face)]
    for before, strength in pairwise(strengths):
        start = moved + (strength - before) * carried
        moved = sheet.equilibrium(start, (bed + held)[:, 0], strength * target, fixed.reshape(-1, 3))
        upper = offset(middle + moved.reshape(face.shape), THICKNESS_MM / 2) - face
        found.append(upper - strength * carried.reshape(face.shape))
    return MovingSheet(a, b, CubicSpline(strengths, np.stack(found)), rise, growth)
