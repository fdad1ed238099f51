# pyright: reportGeneralTypeIssues=false
"""The harmonics of `render.sh` and their gradients inside Triton kernels: one Gaussian per lane, float32.

Coefficients are read where they are needed, so that no kernel holds 48 of them at once. The rows of two lanes are far
apart in memory, where a load or a store costs the same for one number as for four: so four harmonics at a time, three
times four numbers. Rows are `sh + lane * 3K + 3i + channel`; lanes outside `mask` read 0 and write nothing.
"""

from __future__ import annotations

import triton
import triton.language as tl

from .. import sh
from .launch import load_three, store_three

C0, C1 = tl.constexpr(sh.C0), tl.constexpr(sh.C1)
C2_XY, C2_ZZ, C2_XX = tl.constexpr(sh.C2_XY), tl.constexpr(sh.C2_ZZ), tl.constexpr(sh.C2_XX)
C3_CUBE, C3_XYZ, C3_ZZ = tl.constexpr(sh.C3_CUBE), tl.constexpr(sh.C3_XYZ), tl.constexpr(sh.C3_ZZ)
C3_ZZZ, C3_ZXX = tl.constexpr(sh.C3_ZZZ), tl.constexpr(sh.C3_ZXX)


@triton.jit
def _load_four(place, mask):
    # Four neighboring numbers.
    quad = tl.load(place[:, None] + tl.arange(0, 4)[None, :], mask[:, None], 0.0)
    even, odd = tl.split(tl.reshape(quad, (place.shape[0], 2, 2)))
    n0, n2 = tl.split(even)
    n1, n3 = tl.split(odd)
    return n0, n1, n2, n3


@triton.jit
def _store_four(place, n0, n1, n2, n3, mask):
    quad = tl.reshape(tl.join(tl.join(n0, n2), tl.join(n1, n3)), (place.shape[0], 4))
    tl.store(place[:, None] + tl.arange(0, 4)[None, :], quad, mask[:, None])


@triton.jit
def _add(row, i: tl.constexpr, value, red, green, blue, mask):
    # Adds one harmonic times its coefficients.
    r, g, b = load_three(row + 3 * i, mask)
    return red + value * r, green + value * g, blue + value * b


@triton.jit
def _add_four(row, i: tl.constexpr, v0, v1, v2, v3, red, green, blue, mask):
    # Adds harmonics i to i + 3 times their coefficients.
    r0, g0, b0, r1 = _load_four(row + 3 * i, mask)
    g1, b1, r2, g2 = _load_four(row + 3 * i + 4, mask)
    b2, r3, g3, b3 = _load_four(row + 3 * i + 8, mask)
    red += v0 * r0 + v1 * r1 + v2 * r2 + v3 * r3
    green += v0 * g0 + v1 * g1 + v2 * g2 + v3 * g3
    blue += v0 * b0 + v1 * b1 + v2 * b2 + v3 * b3
    return red, green, blue


@triton.jit
def _degree_2(x, y, z):
    # Harmonics 4 to 8.
    xx, yy = x * x, y * y
    return x * y * C2_XY, y * z * -C2_XY, (2 * z * z - xx - yy) * C2_ZZ, x * z * -C2_XY, (xx - yy) * C2_XX


@triton.jit
def _degree_3(x, y, z):
    # Harmonics 9 to 15.
    xx, yy, zz = x * x, y * y, z * z
    v9, v10, v11 = y * (3 * xx - yy) * -C3_CUBE, x * y * z * C3_XYZ, y * (4 * zz - xx - yy) * -C3_ZZ
    v12, v13 = z * (2 * zz - 3 * xx - 3 * yy) * C3_ZZZ, x * (4 * zz - xx - yy) * -C3_ZZ
    return v9, v10, v11, v12, v13, z * (xx - yy) * C3_ZXX, x * (xx - 3 * yy) * -C3_CUBE


@triton.jit
def expand(row, x, y, z, mask, DEGREE: tl.constexpr):
    """Expansion + 0.5 in the unit direction (x, y, z), before it is cut off at 0."""
    r, g, b = tl.zeros_like(x) + 0.5, tl.zeros_like(x) + 0.5, tl.zeros_like(x) + 0.5
    v0 = tl.zeros_like(x) + C0
    if DEGREE == 0:
        r, g, b = _add(row, 0, v0, r, g, b, mask)
    else:
        r, g, b = _add_four(row, 0, v0, y * -C1, z * C1, x * -C1, r, g, b, mask)
        if DEGREE >= 2:
            v4, v5, v6, v7, v8 = _degree_2(x, y, z)
            r, g, b = _add_four(row, 4, v4, v5, v6, v7, r, g, b, mask)
            if DEGREE == 2:
                r, g, b = _add(row, 8, v8, r, g, b, mask)
            else:
                v9, v10, v11, v12, v13, v14, v15 = _degree_3(x, y, z)
                r, g, b = _add_four(row, 8, v8, v9, v10, v11, r, g, b, mask)
                r, g, b = _add_four(row, 12, v12, v13, v14, v15, r, g, b, mask)
    return r, g, b


@triton.jit
def _pull(row, v_row, i: tl.constexpr, value, vr, vg, vb, mask, written):
    # Writes dL/d(coefficients) of one harmonic, and returns dL/d(harmonic).
    store_three(v_row + 3 * i, value * vr, value * vg, value * vb, written)
    r, g, b = load_three(row + 3 * i, mask)
    return vr * r + vg * g + vb * b


@triton.jit
def _pull_four(row, v_row, i: tl.constexpr, v0, v1, v2, v3, vr, vg, vb, mask, written):
    # Writes dL/d(coefficients) of harmonics i to i + 3, and returns dL/d(harmonics).
    _store_four(v_row + 3 * i, v0 * vr, v0 * vg, v0 * vb, v1 * vr, written)
    _store_four(v_row + 3 * i + 4, v1 * vg, v1 * vb, v2 * vr, v2 * vg, written)
    _store_four(v_row + 3 * i + 8, v2 * vb, v3 * vr, v3 * vg, v3 * vb, written)
    r0, g0, b0, r1 = _load_four(row + 3 * i, mask)
    g1, b1, r2, g2 = _load_four(row + 3 * i + 4, mask)
    b2, r3, g3, b3 = _load_four(row + 3 * i + 8, mask)
    return (
        vr * r0 + vg * g0 + vb * b0,
        vr * r1 + vg * g1 + vb * b1,
        vr * r2 + vg * g2 + vb * b2,
        vr * r3 + vg * g3 + vb * b3,
    )


@triton.jit
def _pull_degree_2(x, y, z, p4, p5, p6, p7, p8):
    # dL/d(x, y, z) from dL/d(harmonics 4 to 8).
    v_x = (y * p4 - z * p7) * C2_XY - x * p6 * (2 * C2_ZZ) + x * p8 * (2 * C2_XX)
    v_y = (x * p4 - z * p5) * C2_XY - y * p6 * (2 * C2_ZZ) - y * p8 * (2 * C2_XX)
    v_z = z * p6 * (4 * C2_ZZ) - (y * p5 + x * p7) * C2_XY
    return v_x, v_y, v_z


@triton.jit
def _pull_degree_3(x, y, z, p9, p10, p11, p12, p13, p14, p15):
    # dL/d(x, y, z) from dL/d(harmonics 9 to 15).
    xx, yy, zz = x * x, y * y, z * z
    p9, p10, p11, p12 = p9 * (3 * C3_CUBE), p10 * C3_XYZ, p11 * C3_ZZ, p12 * (3 * C3_ZZZ)
    p13, p14, p15 = p13 * C3_ZZ, p14 * C3_ZXX, p15 * (3 * C3_CUBE)
    v_x = -2 * x * y * p9 + y * z * p10 + 2 * x * y * p11 - 2 * x * z * p12
    v_x += -(4 * zz - 3 * xx - yy) * p13 + 2 * x * z * p14 - (xx - yy) * p15
    v_y = -(xx - yy) * p9 + x * z * p10 - (4 * zz - xx - 3 * yy) * p11 - 2 * y * z * p12
    v_y += 2 * x * y * p13 - 2 * y * z * p14 + 2 * x * y * p15
    v_z = x * y * p10 - 8 * y * z * p11 + (2 * zz - xx - yy) * p12 - 8 * x * z * p13 + (xx - yy) * p14
    return v_x, v_y, v_z


@triton.jit
def pull_back(row, v_row, x, y, z, vr, vg, vb, mask, written, DEGREE: tl.constexpr):
    """Write dL/d(coefficients) at `v_row` for the lanes in `written`; return dL/d(x, y, z).

    The polynomials are taken as they are written in `expand`. (vr, vg, vb): dL/d(expansion), 0 outside `mask`.
    """
    v_x, v_y, v_z = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    v0 = v_x + C0
    if DEGREE == 0:
        _pull(row, v_row, 0, v0, vr, vg, vb, mask, written)
    else:
        _, p1, p2, p3 = _pull_four(row, v_row, 0, v0, y * -C1, z * C1, x * -C1, vr, vg, vb, mask, written)
        v_x, v_y, v_z = p3 * -C1, p1 * -C1, p2 * C1
        if DEGREE >= 2:
            v4, v5, v6, v7, v8 = _degree_2(x, y, z)
            p4, p5, p6, p7 = _pull_four(row, v_row, 4, v4, v5, v6, v7, vr, vg, vb, mask, written)
            if DEGREE == 2:
                p8 = _pull(row, v_row, 8, v8, vr, vg, vb, mask, written)
            else:
                v9, v10, v11, v12, v13, v14, v15 = _degree_3(x, y, z)
                p8, p9, p10, p11 = _pull_four(row, v_row, 8, v8, v9, v10, v11, vr, vg, vb, mask, written)
                p12, p13, p14, p15 = _pull_four(row, v_row, 12, v12, v13, v14, v15, vr, vg, vb, mask, written)
                a, b, c = _pull_degree_3(x, y, z, p9, p10, p11, p12, p13, p14, p15)
                v_x, v_y, v_z = v_x + a, v_y + b, v_z + c
            a, b, c = _pull_degree_2(x, y, z, p4, p5, p6, p7, p8)
            v_x, v_y, v_z = v_x + a, v_y + b, v_z + c
    return v_x, v_y, v_z
