"""A cylinder of known radius under perspective: where its axis is, from the two straight edges of its image.

The edges of its image are those of the two planes through the camera center that touch it. With inward unit normals n1
and n2 of the planes, half the angle between the planes, a, has sin(a) = |n1 + n2| / 2. Both planes contain the axis'
direction, which therefore is n1 x n2, and the axis is at distance D = r / sin(a) from the camera center. The formulas
are exact; a cylinder seen from its end has no such edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
