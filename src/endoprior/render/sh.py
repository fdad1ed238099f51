"""Color that depends on the viewing direction: real spherical harmonics of degree 0 to 3, in PyTorch.

Order and signs are those of 3DGS PLY files: coefficients (l, m) with m = -l..l, Condon-Shortley phase kept. With the
Legendre functions written out, each is a constant times a polynomial of the unit direction (x, y, z).
Shared letters: `N` Gaussians, `K = (degree + 1)**2` coefficients.
"""

from __future__ import annotations

from math import isqrt, pi, sqrt

import torch
from torch import Tensor

MAX_DEGREE = 3
# Square roots of rationals over pi: the normalization that makes the integral of each squared function over the sphere
# 1.
C0 = sqrt(1 / (4 * pi))
C1 = sqrt(3 / (4 * pi))
C2_XY, C2_ZZ, C2_XX = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi)), sqrt(15 / (16 * pi))
C3_CUBE, C3_XYZ, C3_ZZ = sqrt(35 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(21 / (32 * pi))
C3_ZZZ, C3_ZXX = sqrt(7 / (16 * pi)), sqrt(105 / (16 * pi))


def degree_of(num_coefficients: int) -> int:
    """Degree whose expansion has that many coefficients; ValueError if they are not 1, 4, 9 or 16."""
    degree = isqrt(num_coefficients) - 1
    if (degree + 1) ** 2 != num_coefficients or not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"sh must have 1, 4, 9 or 16 coefficients per channel; got {num_coefficients}")
    return degree


def basis(directions: Tensor, degree: int) -> Tensor:
    """(N, K) values of the harmonics at (N, 3) unit directions."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        values += [C2_XY * x * y, -C2_XY * y * z, C2_ZZ * (2 * zz - xx - yy), -C2_XY * x * z, C2_XX * (xx - yy)]
    if degree >= 3:
        values += [
            -C3_CUBE * y * (3 * xx - yy),
            C3_XYZ * x * y * z,
            -C3_ZZ * y * (4 * zz - xx - yy),
            C3_ZZZ * z * (2 * zz - 3 * xx - 3 * yy),
            -C3_ZZ * x * (4 * zz - xx - yy),
            C3_ZXX * z * (xx - yy),
            -C3_CUBE * x * (xx - 3 * yy),
        ]
    return torch.stack(values, -1)


def colors(sh: Tensor, directions: Tensor) -> Tensor:
    """(N, 3) color >= 0 of (N, K, 3) `sh` along (N, 3) unit directions: the expansion + 0.5, cut off at 0."""
    values = basis(directions, degree_of(sh.shape[1]))
    return ((values[:, :, None] * sh).sum(1) + 0.5).clamp(min=0)
