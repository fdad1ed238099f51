# pyright: reportGeneralTypeIssues=false
"""EWA projection and color of all Gaussians as Triton kernels, forward and backward, one Gaussian per lane.

The PyTorch implementation is `render.projection.project`. Compositing takes the LDL^T factors (a, k, m) of the conic,
y first: `power = -(a (dy + k dx)^2 + m dx^2) / 2`. With covariance (xx, xy, yy): `a = xx / det`, `k = -xy / xx`,
`m = 1 / xx`. Nothing cancels, in `det` neither (see `numba.projection`).

Geometry is float64 inside, as on the CPU: a few hundred operations per Gaussian, some microseconds per image even where
float64 runs at 1/64 of the speed, for centers and gradients that agree with the reference to float32 rounding.
Colors are float32. In this file `v_x` is dL/dx; `lens` is what `lens_of` returns.

Coefficients of the harmonics are read where they are needed, so that no kernel holds 48 of them at once. The rows of
two lanes are far apart in memory, where a load or a store costs the same for one number as for four: so four harmonics
at a time, three times four numbers. Rows are `sh + lane * 3K + 3i + channel`; lanes outside `mask` read 0 and write
nothing.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from ...core.types import Camera
from .. import sh
from ..constants import ALPHA_MIN, BLUR_PX2, MIN_QUAT, NEAR_Z, OVERFLOW
from ..projection import jacobian_limits
from .launch import load_three, store_three

BLOCK = 128
"""Gaussians per program."""
KEPT_CAMERAS = 1024
"""Cameras whose numbers stay on the device."""
CENTER, FX, LIMITS, LENS_SIZE = tl.constexpr(12), tl.constexpr(15), tl.constexpr(19), tl.constexpr(23)
"""Where the parts of `lens` begin, after the view, and where it ends."""
_ALPHA_MIN, _BLUR, _NEAR_Z = tl.constexpr(ALPHA_MIN), tl.constexpr(BLUR_PX2), tl.constexpr(NEAR_Z)
_MIN_QUAT, _OVERFLOW = tl.constexpr(MIN_QUAT), tl.constexpr(OVERFLOW)
C0, C1 = tl.constexpr(sh.C0), tl.constexpr(sh.C1)
C2_XY, C2_ZZ, C2_XX = tl.constexpr(sh.C2_XY), tl.constexpr(sh.C2_ZZ), tl.constexpr(sh.C2_XX)
C3_CUBE, C3_XYZ, C3_ZZ = tl.constexpr(sh.C3_CUBE), tl.constexpr(sh.C3_XYZ), tl.constexpr(sh.C3_ZZ)
C3_ZZZ, C3_ZXX = tl.constexpr(sh.C3_ZZZ), tl.constexpr(sh.C3_ZXX)


def lens_of(camera: Camera, device: torch.device) -> Tensor:
    """(LENS_SIZE,) float64 on that device: view (3, 4), center (3,), fx fy cx cy, left right top bottom.

    Those of cameras seen before are there already: no copy, no waiting.
    """
    view = np.asarray(camera.world_to_camera, np.float64)[:3]
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    numbers = np.concatenate([view.ravel(), camera.center, intrinsics, jacobian_limits(camera)])
    return _on_device(numbers.astype(np.float64).tobytes(), device)


@lru_cache(maxsize=KEPT_CAMERAS)
def _on_device(numbers: bytes, device: torch.device) -> Tensor:
    # By value: an array that is changed in place, or an address that is used again, finds no stale numbers.
    return torch.from_numpy(np.frombuffer(numbers).copy()).to(device)


@triton.jit
def _double(value: tl.constexpr):
    # A constant in float64; some versions of Triton round a plain one to float32 first.
    return tl.full((), value, tl.float64)


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
def _expand(row, x, y, z, mask, DEGREE: tl.constexpr):
    # Expansion + 0.5 in the unit direction (x, y, z), before it is cut off at 0.
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
def _pull_back(row, v_row, x, y, z, vr, vg, vb, mask, written, DEGREE: tl.constexpr):
    # Writes dL/d(coefficients) at `v_row` for the lanes in `written`; returns dL/d(x, y, z). The polynomials are taken
    # as they are written in `_expand`. (vr, vg, vb): dL/d(expansion), 0 outside `mask`.
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


@triton.jit
def _center(row, lens, mask):
    # Means in the world (wx, wy, wz) and in the camera (x, y, z).
    wx, wy, wz = load_three(row, mask)
    wx, wy, wz = wx.to(tl.float64), wy.to(tl.float64), wz.to(tl.float64)
    x = tl.load(lens) * wx + tl.load(lens + 1) * wy + tl.load(lens + 2) * wz + tl.load(lens + 3)
    y = tl.load(lens + 4) * wx + tl.load(lens + 5) * wy + tl.load(lens + 6) * wz + tl.load(lens + 7)
    z = tl.load(lens + 8) * wx + tl.load(lens + 9) * wy + tl.load(lens + 10) * wz + tl.load(lens + 11)
    return wx, wy, wz, x, y, z


@triton.jit
def _unit_quat(row, mask):
    # (w, x, y, z) at length 1, and the length it had.
    w = tl.load(row, mask, 1.0).to(tl.float64)
    x, y, z = load_three(row + 1, mask)
    x, y, z = x.to(tl.float64), y.to(tl.float64), z.to(tl.float64)
    length = tl.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length, length


@triton.jit
def _to_camera(lens, i: tl.constexpr, x, y, z):
    # Row i of the view's rotation times (x, y, z).
    return tl.load(lens + 4 * i) * x + tl.load(lens + 4 * i + 1) * y + tl.load(lens + 4 * i + 2) * z


@triton.jit
def _to_world(lens, i: tl.constexpr, x, y, z):
    # Column i of the view's rotation times (x, y, z).
    return tl.load(lens + i) * x + tl.load(lens + 4 + i) * y + tl.load(lens + 8 + i) * z


@triton.jit
def _rotation_column(quat, j: tl.constexpr):
    # Column j of the rotation by a unit quaternion.
    w, x, y, z = quat
    if j == 0:
        r0, r1, r2 = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    elif j == 1:
        r0, r1, r2 = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)
    else:
        r0, r1, r2 = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
    return r0, r1, r2


@triton.jit
def _spread(lens, quat, row, j: tl.constexpr, slopes, gains, mask):
    # Column j of J times the axes; and that axis' z in the camera frame.
    slope_x, slope_y = slopes
    gx, gy = gains
    rx, ry, rz = _rotation_column(quat, j)
    scale = _scale(row, j, mask)
    axis_z = scale * _to_camera(lens, 2, rx, ry, rz)
    b = gx * (scale * _to_camera(lens, 0, rx, ry, rz) - slope_x * axis_z)
    c = gy * (scale * _to_camera(lens, 1, rx, ry, rz) - slope_y * axis_z)
    return b, c, axis_z


@triton.jit
def _kept(value, mask):
    # In float32; 0 outside the mask.
    return tl.where(mask, value, 0.0).to(tl.float32)


@triton.jit
def _double_at(place, mask):
    return tl.load(place, mask, 0.0).to(tl.float64)


@triton.jit
def _scale(row, j: tl.constexpr, mask):
    return tl.load(row + j, mask, 1.0).to(tl.float64)


@triton.jit
def _project(means, quats, scales, lens, g, mask):
    # What both passes need: centers, slopes, J times the axes (rows b, c), covariance and its determinant.
    wx, wy, wz, x, y, z = _center(means + 3 * g, lens, mask)
    qw, qx, qy, qz, length = _unit_quat(quats + 4 * g, mask)
    world, center, quat = (wx, wy, wz), (x, y, z), (qw, qx, qy, qz)
    slope_x = tl.minimum(tl.maximum(x / z, tl.load(lens + LIMITS)), tl.load(lens + LIMITS + 1))
    slope_y = tl.minimum(tl.maximum(y / z, tl.load(lens + LIMITS + 2)), tl.load(lens + LIMITS + 3))
    slopes, gains = (slope_x, slope_y), (tl.load(lens + FX) / z, tl.load(lens + FX + 1) / z)
    b0, c0, z0 = _spread(lens, quat, scales + 3 * g, 0, slopes, gains, mask)
    b1, c1, z1 = _spread(lens, quat, scales + 3 * g, 1, slopes, gains, mask)
    b2, c2, z2 = _spread(lens, quat, scales + 3 * g, 2, slopes, gains, mask)
    bb, bc, cc = b0 * b0 + b1 * b1 + b2 * b2, b0 * c0 + b1 * c1 + b2 * c2, c0 * c0 + c1 * c1 + c2 * c2
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    blur = _double(_BLUR)
    det = n0 * n0 + n1 * n1 + n2 * n2 + blur * (bb + cc) + blur * blur
    spread, cov = (b0, b1, b2, c0, c1, c2), (bb + blur, bc, cc + blur, det)
    return world, center, quat, length, slopes, gains, spread, (z0, z1, z2), cov


@triton.jit
def _direction(world, lens):
    # Unit vector from the camera to the mean, and 1 / distance.
    wx, wy, wz = world
    x, y, z = wx - tl.load(lens + CENTER), wy - tl.load(lens + CENTER + 1), wz - tl.load(lens + CENTER + 2)
    inverse = 1.0 / tl.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def _local_per_px(spread, cov):
    # Change of the first two local coordinates, in standard deviations, per px along x, then y: see `_local_per_px` of
    # `render.projection`.
    b0, b1, _, c0, c1, _ = spread
    xx, xy, yy, det = cov
    return (yy * b0 - xy * c0) / det, (yy * b1 - xy * c1) / det, (xx * c0 - xy * b0) / det, (xx * c1 - xy * b1) / det


@triton.jit(do_not_specialize=["num", "width", "height"])
def project_forward(
    means, quats, scales, opacities, sh, color_slopes, lens, num, width, height,
    means2d, conic_ldl, z_out, colors, color_slopes2d, radii,
    DEGREE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One program per BLOCK Gaussians. Writes one row each of means2d (N, 2), conic_ldl (N, 3), z_out (N,),
    colors (N, 3), color_slopes2d (N, 2, 3) and radii (N,). Culled: all zeros."""
    g = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = g < num
    world, center, _, length, _, _, spread, _, cov = _project(means, quats, scales, lens, g, mask)
    x, y, z = center
    xx, xy, yy, det = cov
    px = tl.load(lens + FX) * x / z + tl.load(lens + FX + 2)
    py = tl.load(lens + FX + 1) * y / z + tl.load(lens + FX + 3)
    ux, uy, uz, _ = _direction(world, lens)
    num_sh: tl.constexpr = (DEGREE + 1) * (DEGREE + 1)
    ahead = mask & (z > _double(_NEAR_Z))  # those behind need no coefficients
    row = sh + g * (3 * num_sh)
    red, green, blue = _expand(row, ux.to(tl.float32), uy.to(tl.float32), uz.to(tl.float32), ahead, DEGREE)
    opacity = tl.load(opacities + g, mask, 0.0)
    # One sum notices every NaN and infinity.
    shades = tl.abs(red).to(tl.float64) + tl.abs(green).to(tl.float64) + tl.abs(blue).to(tl.float64)
    size = tl.abs(px) + tl.abs(py) + z + xx * yy + shades + tl.abs(opacity).to(tl.float64)
    for i in tl.static_range(6):
        size += tl.abs(tl.load(color_slopes + 6 * g + i, mask, 0.0)).to(tl.float64)  # a pixel adds at most 0.92 of it
    usable = ahead & (size < _double(_OVERFLOW)) & (length >= _double(_MIN_QUAT))  # False for NaN

    level = 2.0 * tl.log(tl.maximum(opacity / _ALPHA_MIN, 1.0)).to(tl.float64)  # squared reach, in sigmas
    reach_x, reach_y = tl.sqrt(level * xx), tl.sqrt(level * yy)
    touches = (px + reach_x >= 0.5) & (px - reach_x <= width - 0.5) & (py + reach_y >= 0.5)
    visible = usable & touches & (py - reach_y <= height - 0.5) & (opacity >= _ALPHA_MIN)
    half = 0.5 * (xx - yy)
    long_axis = 0.5 * (xx + yy) + tl.sqrt(half * half + xy * xy)
    radius = tl.where(visible, tl.minimum(tl.ceil(3.0 * tl.sqrt(long_axis)), 1073741824.0), 0.0)

    tl.store(means2d + 2 * g, _kept(px, usable), mask)
    tl.store(means2d + 2 * g + 1, _kept(py, usable), mask)
    a, k, m = _kept(xx / det, usable), _kept(-xy / xx, usable), _kept(1.0 / xx, usable)
    store_three(conic_ldl + 3 * g, a, k, m, mask)
    tl.store(z_out + g, _kept(z, usable), mask)
    red, green, blue = tl.maximum(red, 0.0), tl.maximum(green, 0.0), tl.maximum(blue, 0.0)
    store_three(colors + 3 * g, _kept(red, usable), _kept(green, usable), _kept(blue, usable), mask)
    x0, x1, y0, y1 = _local_per_px(spread, cov)
    for i in tl.static_range(3):
        first = _double_at(color_slopes + 6 * g + i, mask)
        second = _double_at(color_slopes + 6 * g + 3 + i, mask)
        row = color_slopes2d + 6 * g + i
        tl.store(row, _kept(x0 * first + x1 * second, usable), mask)
        tl.store(row + 3, _kept(y0 * first + y1 * second, usable), mask)
    tl.store(radii + g, radius.to(tl.int32), mask)


@triton.jit
def _slopes_backward(color_slopes, v_color_slopes2d, v_color_slopes, spread, cov, g, mask, written):
    # Slopes of the color, P^T times color_slopes with P = inverse covariance times b, c of two axes -> color_slopes,
    # stored; P: (b0, b1, c0, c1), without what the covariance adds to it, and covariance (xx, xy, yy), returned.
    xx, xy, yy, det = cov
    x0, x1, y0, y1 = _local_per_px(spread, cov)
    v_x0, v_x1, v_y0, v_y1 = tl.zeros_like(x0), tl.zeros_like(x0), tl.zeros_like(x0), tl.zeros_like(x0)
    for i in tl.static_range(3):
        along_x = _double_at(v_color_slopes2d + 6 * g + i, mask)
        along_y = _double_at(v_color_slopes2d + 6 * g + 3 + i, mask)
        first = _double_at(color_slopes + 6 * g + i, mask)
        second = _double_at(color_slopes + 6 * g + 3 + i, mask)
        v_x0, v_x1 = v_x0 + along_x * first, v_x1 + along_x * second
        v_y0, v_y1 = v_y0 + along_y * first, v_y1 + along_y * second
        v_first = _kept(x0 * along_x + y0 * along_y, mask)
        v_second = _kept(x1 * along_x + y1 * along_y, mask)
        tl.store(v_color_slopes + 6 * g + i, v_first, written)
        tl.store(v_color_slopes + 6 * g + 3 + i, v_second, written)
    vb0, vc0 = (yy * v_x0 - xy * v_y0) / det, (xx * v_y0 - xy * v_x0) / det
    vb1, vc1 = (yy * v_x1 - xy * v_y1) / det, (xx * v_y1 - xy * v_x1) / det
    v_xx = -vb0 * x0 - vb1 * x1
    v_yy = -vc0 * y0 - vc1 * y1
    v_xy = -vb0 * y0 - vb1 * y1 - vc0 * x0 - vc1 * x1
    return (vb0, vb1, vc0, vc1), (v_xx, v_xy, v_yy)


@triton.jit
def _covariance_backward(v_conic_ldl, v_cov, v_spread, spread, cov, g, mask):
    # LDL^T factors -> covariance -> rows b, c of J times the axes. Adds to the `v_cov` and `v_spread` of the slopes.
    b0, b1, b2, c0, c1, c2 = spread
    xx, xy, _, det = cov
    v_xx, v_xy, v_yy = v_cov
    v_a = _double_at(v_conic_ldl + 3 * g, mask)
    v_k = _double_at(v_conic_ldl + 3 * g + 1, mask)
    v_m = _double_at(v_conic_ldl + 3 * g + 2, mask)
    v_det = -v_a * xx / (det * det)
    v_yy += v_det * xx
    v_xy += -2.0 * v_det * xy - v_k / xx
    v_xx += -v_a * (xy / det) * (xy / det) + (v_k * xy - v_m) / (xx * xx)
    vb0, vb1, vb2 = 2 * v_xx * b0 + v_xy * c0, 2 * v_xx * b1 + v_xy * c1, 2 * v_xx * b2 + v_xy * c2
    vc0, vc1, vc2 = 2 * v_yy * c0 + v_xy * b0, 2 * v_yy * c1 + v_xy * b1, 2 * v_yy * c2 + v_xy * b2
    slope_b0, slope_b1, slope_c0, slope_c1 = v_spread
    return vb0 + slope_b0, vb1 + slope_b1, vb2, vc0 + slope_c0, vc1 + slope_c1, vc2


@triton.jit
def _center_backward(lens, v_means2d, v_z, v_spread, center, gains, spread, axes_z, g, mask):
    # Center in the image, z, and rows of J times the axes -> center in the camera frame.
    x, y, z = center
    gx, gy = gains
    b0, b1, b2, c0, c1, c2 = spread
    z0, z1, z2 = axes_z
    vb0, vb1, vb2, vc0, vc1, vc2 = v_spread
    v_x = _double_at(v_means2d + 2 * g, mask) * gx
    v_y = _double_at(v_means2d + 2 * g + 1, mask) * gy
    v_depth = _double_at(v_z + g, mask) - (v_x * x + v_y * y) / z
    v_depth -= (vb0 * b0 + vb1 * b1 + vb2 * b2 + vc0 * c0 + vc1 * c1 + vc2 * c2) / z
    inside = (x / z >= tl.load(lens + LIMITS)) & (x / z <= tl.load(lens + LIMITS + 1))
    v_slope = tl.where(inside, -gx * (vb0 * z0 + vb1 * z1 + vb2 * z2), 0.0)
    v_x += v_slope / z
    v_depth -= v_slope * x / (z * z)
    inside = (y / z >= tl.load(lens + LIMITS + 2)) & (y / z <= tl.load(lens + LIMITS + 3))
    v_slope = tl.where(inside, -gy * (vc0 * z0 + vc1 * z1 + vc2 * z2), 0.0)
    v_y += v_slope / z
    v_depth -= v_slope * y / (z * z)
    return v_x, v_y, v_depth


@triton.jit
def _color_backward(sh, v_sh, v_colors, world, lens, g, mask, written, DEGREE: tl.constexpr):
    # Color -> coefficients, stored, and direction of view -> mean in the world, returned.
    ux, uy, uz, inverse = _direction(world, lens)
    fx, fy, fz = ux.to(tl.float32), uy.to(tl.float32), uz.to(tl.float32)
    num_sh: tl.constexpr = (DEGREE + 1) * (DEGREE + 1)
    row, v_row = sh + g * (3 * num_sh), v_sh + g * (3 * num_sh)
    red, green, blue = _expand(row, fx, fy, fz, mask, DEGREE)
    vr = tl.where(mask & (red >= 0), tl.load(v_colors + 3 * g, mask, 0.0), 0.0)
    vg = tl.where(mask & (green >= 0), tl.load(v_colors + 3 * g + 1, mask, 0.0), 0.0)
    vb = tl.where(mask & (blue >= 0), tl.load(v_colors + 3 * g + 2, mask, 0.0), 0.0)
    fx, fy, fz = tl.where(mask, fx, 0.0), tl.where(mask, fy, 0.0), tl.where(mask, fz, 0.0)  # 0 times NaN is not 0
    wx, wy, wz = _pull_back(row, v_row, fx, fy, fz, vr, vg, vb, mask, written, DEGREE)
    dx, dy, dz = wx.to(tl.float64), wy.to(tl.float64), wz.to(tl.float64)
    along = dx * ux + dy * uy + dz * uz
    return inverse * (dx - along * ux), inverse * (dy - along * uy), inverse * (dz - along * uz)


@triton.jit
def _axis_backward(row, v_row, lens, quat, j: tl.constexpr, vb, vc, slopes, gains, mask, written):
    # dL/d(b, c) of axis j -> dL/d(axis in the camera frame) -> dL/d(scale), stored, and dL/d(rotation), returned.
    slope_x, slope_y = slopes
    gx, gy = gains
    r0, r1, r2 = _rotation_column(quat, j)
    vz = -slope_x * gx * vb - slope_y * gy * vc
    v0, v1 = gx * vb, gy * vc
    m0, m1, m2 = _to_world(lens, 0, v0, v1, vz), _to_world(lens, 1, v0, v1, vz), _to_world(lens, 2, v0, v1, vz)
    v_scale = m0 * r0 + m1 * r1 + m2 * r2
    tl.store(v_row + j, _kept(v_scale, mask), written)
    scale = _scale(row, j, mask)
    return m0 * scale, m1 * scale, m2 * scale


@triton.jit
def _quat_backward(v_row, quat, length, v_column0, v_column1, v_column2, mask, written):
    # dL/d(columns of the rotation) -> dL/d(quaternion), through its normalization, stored.
    qw, qx, qy, qz = quat
    m00, m10, m20 = v_column0
    m01, m11, m21 = v_column1
    m02, m12, m22 = v_column2
    v_w = 2 * (qx * (m21 - m12) + qy * (m02 - m20) + qz * (m10 - m01))
    v_i = 2 * (qy * (m01 + m10) + qz * (m02 + m20) + qw * (m21 - m12)) - 4 * qx * (m11 + m22)
    v_j = 2 * (qx * (m01 + m10) + qz * (m12 + m21) + qw * (m02 - m20)) - 4 * qy * (m00 + m22)
    v_k = 2 * (qx * (m02 + m20) + qy * (m12 + m21) + qw * (m10 - m01)) - 4 * qz * (m00 + m11)
    along = v_w * qw + v_i * qx + v_j * qy + v_k * qz
    tl.store(v_row, _kept((v_w - along * qw) / length, mask), written)
    tl.store(v_row + 1, _kept((v_i - along * qx) / length, mask), written)
    tl.store(v_row + 2, _kept((v_j - along * qy) / length, mask), written)
    tl.store(v_row + 3, _kept((v_k - along * qz) / length, mask), written)


@triton.jit(do_not_specialize=["num"])
def project_backward(
    means, quats, scales, sh, color_slopes, lens, num, radii, v_means2d, v_conic_ldl, v_z, v_colors, v_color_slopes2d,
    v_means, v_quats, v_scales, v_sh, v_color_slopes,
    DEGREE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One program per BLOCK Gaussians. Writes one row of each of the last five tensors; zeros where radii is 0."""
    g = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    written = g < num
    mask = tl.load(radii + g, written, 0) > 0
    world, center, quat, length, slopes, gains, spread, axes_z, cov = _project(means, quats, scales, lens, g, mask)

    v_spread, v_cov = _slopes_backward(color_slopes, v_color_slopes2d, v_color_slopes, spread, cov, g, mask, written)
    v_spread = _covariance_backward(v_conic_ldl, v_cov, v_spread, spread, cov, g, mask)
    vx, vy, vz = _center_backward(lens, v_means2d, v_z, v_spread, center, gains, spread, axes_z, g, mask)
    dx, dy, dz = _color_backward(sh, v_sh, v_colors, world, lens, g, mask, written, DEGREE)
    dx, dy = dx + _to_world(lens, 0, vx, vy, vz), dy + _to_world(lens, 1, vx, vy, vz)
    dz += _to_world(lens, 2, vx, vy, vz)
    store_three(v_means + 3 * g, _kept(dx, mask), _kept(dy, mask), _kept(dz, mask), written)

    vb0, vb1, vb2, vc0, vc1, vc2 = v_spread
    row, v_row = scales + 3 * g, v_scales + 3 * g
    v_column0 = _axis_backward(row, v_row, lens, quat, 0, vb0, vc0, slopes, gains, mask, written)
    v_column1 = _axis_backward(row, v_row, lens, quat, 1, vb1, vc1, slopes, gains, mask, written)
    v_column2 = _axis_backward(row, v_row, lens, quat, 2, vb2, vc2, slopes, gains, mask, written)
    _quat_backward(v_quats + 4 * g, quat, length, v_column0, v_column1, v_column2, mask, written)
