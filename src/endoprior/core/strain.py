"""How a surface is deformed: principal stretches, their direction and the change of area, from a gradient."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Strain(NamedTuple):
    """Deformation of pieces of a surface since some time at which it was undeformed; NaN where unknown."""

    stretch: NDArray[np.float64]
    """(..., 2) largest and smallest principal stretch: length after over length before; 1: unchanged."""
    direction: NDArray[np.float64]
    """(..., 3) unit vector on the undeformed surface along which the stretch is largest; its sign says nothing."""

    @property
    def area(self) -> NDArray[np.float64]:
        """(...,) area after over area before."""
        return self.stretch.prod(-1)


def strain_of(gradient: NDArray, axes: NDArray) -> Strain:
    """The strain of a deformation gradient.

    Args:
        gradient: (..., 3, 2) takes positions along two perpendicular directions of the undeformed surface to positions.
        axes: (..., 3, 2) these directions, unit vectors, as columns.
    """
    _, stretch, rows = np.linalg.svd(gradient, full_matrices=False)
    return Strain(stretch, (axes @ rows[..., 0, :, None])[..., 0])


def strain_between(before: NDArray, after: NDArray) -> Strain:
    """The strain that takes tangents to tangents.

    Args:
        before, after: (..., 3, 2) two tangents of a surface, as columns, along the same material lines.
    """
    axes, lengths = np.linalg.qr(before)
    return strain_of(after @ np.linalg.inv(lengths), axes)
