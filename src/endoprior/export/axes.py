"""Axes of exported coordinates: proper rotations of positions, orientations and direction-dependent color.

World axes are OpenCV's, those of the stored poses: x right, y down, z forward (away from the viewer). Without
registration to a patient, the anatomical axes assume the view of an anatomical atlas: the right of the image is the
patient's left, up is superior, forward is posterior. Nothing is scaled or translated.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..core.types import Splats
from ..render import sh as harmonics
from .formats import Axes

ROTATIONS: dict[str, NDArray[np.float64]] = {
    "opencv": np.eye(3),
    "opengl": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),  # right, up, back
    "lps": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),  # left = x, posterior = z, superior = -y
    "ras": np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]]),  # right = -x, anterior = -z, superior = -y
}
"""(3, 3) from OpenCV axes to each of the others; determinant +1."""


def points_in_axes(points: NDArray, axes: Axes) -> NDArray:
    """(..., 3) positions or directions in OpenCV axes, in `axes`; same type of numbers."""
    return points @ ROTATIONS[axes].T.astype(points.dtype)


def splats_in_axes(splats: Splats, axes: Axes) -> Splats:
    """Gaussians of OpenCV axes in `axes`: the same ellipsoids, with the same color from each side."""
    return rotated(splats, ROTATIONS[axes])


def rotated(splats: Splats, rotation: NDArray[np.float64]) -> Splats:
    """Gaussians rotated about the origin by a (3, 3) proper rotation; the identity changes nothing."""
    if np.array_equal(rotation, np.eye(3)):
        return splats
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    matrix, turn = torch.from_numpy(rotation), _sh_rotation(harmonics.degree_of(splats.sh.shape[1]), rotation.tobytes())
    return Splats(
        means=(splats.means.double() @ matrix.T).to(splats.means.dtype),
        quats=_quaternion_product(torch.tensor([w, x, y, z]), splats.quats.double()).to(splats.quats.dtype),
        scales=splats.scales,
        opacities=splats.opacities,
        sh=torch.einsum("kj,njc->nkc", torch.from_numpy(turn), splats.sh.double()).to(splats.sh.dtype),
        color_slopes=splats.color_slopes,
    )


def _quaternion_product(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product of quaternions (w, x, y, z), shapes (4,) and (N, 4): the rotation `right`, then `left`."""
    a, b, c, d = left.unbind(-1)
    w, x, y, z = right.unbind(-1)
    real, i = a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y
    return torch.stack([real, i, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w], -1)


@cache
def _sh_rotation(degree: int, rotation: bytes) -> NDArray[np.float64]:
    """(K, K) matrix that rotates harmonics up to `degree` by a (3, 3) matrix of float64, given as bytes.

    Degrees do not mix. The block of each solves Y(R d) block = Y(d) by least squares over directions d on a spiral,
    more of them than unknowns; the equations have an exact solution.
    """
    k = np.arange(64)
    height, angle = 1 - (2 * k + 1) / 64, k * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
    turned = directions @ np.frombuffer(rotation).reshape(3, 3).T
    before, after = (harmonics.basis(torch.from_numpy(d.copy()), degree).numpy() for d in (directions, turned))
    matrix = np.zeros(((degree + 1) ** 2,) * 2)
    for band in range(degree + 1):
        own = slice(band**2, (band + 1) ** 2)
        matrix[own, own] = np.linalg.lstsq(after[:, own], before[:, own], rcond=None)[0]
    return matrix
