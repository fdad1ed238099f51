"""The harmonics of `render.sh` and their gradients, one Gaussian at a time.

`values` and `v_values` are rows that the caller owns, so that nothing is allocated per Gaussian.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .. import sh

f4 = np.float32
C0, C1 = f4(sh.C0), f4(sh.C1)
C2_XY, C2_ZZ, C2_XX = f4(sh.C2_XY), f4(sh.C2_ZZ), f4(sh.C2_XX)
C3_CUBE, C3_XYZ, C3_ZZ = f4(sh.C3_CUBE), f4(sh.C3_XYZ), f4(sh.C3_ZZ)
C3_ZZZ, C3_ZXX = f4(sh.C3_ZZZ), f4(sh.C3_ZXX)
TWO, THREE, FOUR, SIX, EIGHT = f4(2), f4(3), f4(4), f4(6), f4(8)


@njit(inline="always")
def write_basis(x, y, z, num, values):
    """Fill values[:num] with the harmonics at the unit direction (x, y, z); num is 1, 4, 9 or 16."""
    values[0] = C0
    if num > 1:
        values[1], values[2], values[3] = -C1 * y, C1 * z, -C1 * x
    if num > 4:
        xx, yy, zz = x * x, y * y, z * z
        values[4], values[5] = C2_XY * x * y, -C2_XY * y * z
        values[6] = C2_ZZ * (TWO * zz - xx - yy)
        values[7], values[8] = -C2_XY * x * z, C2_XX * (xx - yy)
        if num > 9:
            values[9] = -C3_CUBE * y * (THREE * xx - yy)
            values[10] = C3_XYZ * x * y * z
            values[11] = -C3_ZZ * y * (FOUR * zz - xx - yy)
            values[12] = C3_ZZZ * z * (TWO * zz - THREE * xx - THREE * yy)
            values[13] = -C3_ZZ * x * (FOUR * zz - xx - yy)
            values[14] = C3_ZXX * z * (xx - yy)
            values[15] = -C3_CUBE * x * (xx - THREE * yy)


@njit(inline="always")
def direction_gradient(x, y, z, num, v_values):
    """dL/d(x, y, z) from v_values[:num] = dL/d(harmonics), the polynomials taken as they are written above."""
    v_x = v_y = v_z = f4(0)
    v = v_values
    if num > 1:
        v_x, v_y, v_z = -C1 * v[3], -C1 * v[1], C1 * v[2]
    if num > 4:
        v_x += C2_XY * (y * v[4] - z * v[7]) - TWO * C2_ZZ * x * v[6] + TWO * C2_XX * x * v[8]
        v_y += C2_XY * (x * v[4] - z * v[5]) - TWO * C2_ZZ * y * v[6] - TWO * C2_XX * y * v[8]
        v_z += -C2_XY * (y * v[5] + x * v[7]) + FOUR * C2_ZZ * z * v[6]
    if num > 9:
        xx, yy, zz = x * x, y * y, z * z
        v_x += -SIX * C3_CUBE * x * y * v[9] + C3_XYZ * y * z * v[10] + TWO * C3_ZZ * x * y * v[11]
        v_x += -SIX * C3_ZZZ * x * z * v[12] - C3_ZZ * (FOUR * zz - THREE * xx - yy) * v[13]
        v_x += TWO * C3_ZXX * x * z * v[14] - THREE * C3_CUBE * (xx - yy) * v[15]
        v_y += -THREE * C3_CUBE * (xx - yy) * v[9] + C3_XYZ * x * z * v[10]
        v_y += -C3_ZZ * (FOUR * zz - xx - THREE * yy) * v[11] - SIX * C3_ZZZ * y * z * v[12]
        v_y += TWO * C3_ZZ * x * y * v[13] - TWO * C3_ZXX * y * z * v[14] + SIX * C3_CUBE * x * y * v[15]
        v_z += C3_XYZ * x * y * v[10] - EIGHT * C3_ZZ * z * (y * v[11] + x * v[13])
        v_z += C3_ZZZ * (SIX * zz - THREE * xx - THREE * yy) * v[12] + C3_ZXX * (xx - yy) * v[14]
    return v_x, v_y, v_z
