# pyright: reportCallIssue=false
"""EWA projection and color of all Gaussians, forward and backward, one Gaussian per iteration.

The PyTorch implementation is `render.projection.project`. Compositing takes the LDL^T factors (a, k, m) of the conic,
x first: `power = -(a (dx + k dy)^2 + m dy^2) / 2`. With covariance (xx, xy, yy): `a = yy / det`, `k = -xy / yy`,
`m = 1 / yy`. Nothing cancels, in `det` neither: for the blurred product B B^T + b I of a 2x3 matrix with rows r1, r2,
`det = |r1 x r2|^2 + b (|r1|^2 + |r2|^2) + b^2`.

Geometry is float64 inside (the time goes to memory and square roots), colors are float32. In this file `v_x` is dL/dx.
`lens` is (fx, fy, cx, cy, left, right, top, bottom), the last four from `render.projection.jacobian_limits`.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ...compute.parallel_kernels import parallel_njit
from .. import sh
from ..constants import ALPHA_MIN, BLUR_PX2, MIN_QUAT, NEAR_Z, OVERFLOW

f4 = np.float32
HALF = f4(0.5)
C0, C1 = f4(sh.C0), f4(sh.C1)
C2_XY, C2_ZZ, C2_XX = f4(sh.C2_XY), f4(sh.C2_ZZ), f4(sh.C2_XX)
C3_CUBE, C3_XYZ, C3_ZZ = f4(sh.C3_CUBE), f4(sh.C3_XYZ), f4(sh.C3_ZZ)
C3_ZZZ, C3_ZXX = f4(sh.C3_ZZZ), f4(sh.C3_ZXX)
TWO, THREE, FOUR, SIX, EIGHT = f4(2), f4(3), f4(4), f4(6), f4(8)
BLOCK = 256
"""Gaussians per task."""


@njit(inline="always")
def _write_basis(x, y, z, num, values):
    # Fills values[:num] with the harmonics at the unit direction (x, y, z); num is 1, 4, 9 or 16.
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
def _direction_gradient(x, y, z, num, v):
    # dL/d(x, y, z) from v[:num] = dL/d(harmonics), the polynomials taken as they are written above.
    v_x = v_y = v_z = f4(0)
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


@njit(inline="always")
def _expansion(values, sh, g):
    # The harmonics `values` times the coefficients of Gaussian g, + 0.5.
    red = green = blue = HALF
    for i in range(sh.shape[1]):
        red += values[i] * sh[g, i, 0]
        green += values[i] * sh[g, i, 1]
        blue += values[i] * sh[g, i, 2]
    return red, green, blue


@njit(inline="always")
def _center(view, mean):
    # The mean in the world and in the camera.
    wx, wy, wz = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
    x = view[0, 0] * wx + view[0, 1] * wy + view[0, 2] * wz + view[0, 3]
    y = view[1, 0] * wx + view[1, 1] * wy + view[1, 2] * wz + view[1, 3]
    z = view[2, 0] * wx + view[2, 1] * wy + view[2, 2] * wz + view[2, 3]
    return wx, wy, wz, x, y, z


@njit(inline="always")
def _direction(wx, wy, wz, center):
    # Unit vector from the camera to a point, and 1 / distance.
    dx, dy, dz = wx - center[0], wy - center[1], wz - center[2]
    inverse = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
    return dx * inverse, dy * inverse, dz * inverse, inverse


@njit(inline="always")
def _axes(view, quat, scales, turn, axes):
    # Fills turn (3, 3), the rotation, and axes (3, 3): columns are the Gaussian's axes in the camera frame, times their
    # standard deviations. Returns the quaternion at length 1, and the length it had.
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    turn[0, 0], turn[0, 1], turn[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    turn[1, 0], turn[1, 1], turn[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    turn[2, 0], turn[2, 1], turn[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    for i in range(3):
        for j in range(3):
            seen = view[i, 0] * turn[0, j] + view[i, 1] * turn[1, j] + view[i, 2] * turn[2, j]
            axes[i, j] = scales[j] * seen
    return w, x, y, z, length


@njit(inline="always")
def _projected_axes(lens, x, y, z, axes):
    # Rows of J times the axes (Jacobian limited to the neighborhood of the image), and the limited slopes.
    slope_x, slope_y = min(max(x / z, lens[4]), lens[5]), min(max(y / z, lens[6]), lens[7])
    gx, gy = lens[0] / z, lens[1] / z
    b0 = gx * (axes[0, 0] - slope_x * axes[2, 0])
    b1 = gx * (axes[0, 1] - slope_x * axes[2, 1])
    b2 = gx * (axes[0, 2] - slope_x * axes[2, 2])
    c0 = gy * (axes[1, 0] - slope_y * axes[2, 0])
    c1 = gy * (axes[1, 1] - slope_y * axes[2, 1])
    c2 = gy * (axes[1, 2] - slope_y * axes[2, 2])
    return slope_x, slope_y, b0, b1, b2, c0, c1, c2


@njit(inline="always")
def _covariance(b0, b1, b2, c0, c1, c2):
    # xx, xy, yy, det of the blurred covariance.
    bb, bc, cc = b0 * b0 + b1 * b1 + b2 * b2, b0 * c0 + b1 * c1 + b2 * c2, c0 * c0 + c1 * c1 + c2 * c2
    n0, n1, n2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    det = n0 * n0 + n1 * n1 + n2 * n2 + BLUR_PX2 * (bb + cc) + BLUR_PX2**2
    return bb + BLUR_PX2, bc, cc + BLUR_PX2, det


@njit(inline="always")
def _local_per_px(xx, xy, yy, det, b0, b1, c0, c1):
    # Change of the first two local coordinates, in standard deviations, per px along x, then y: see `_local_per_px` of
    # `render.projection`.
    return (
        (yy * b0 - xy * c0) / det, (yy * b1 - xy * c1) / det,
        (xx * c0 - xy * b0) / det, (xx * c1 - xy * b1) / det,
    )  # fmt: skip


@njit(error_model="numpy")
def _project_block(
    block, means, quats, scales, opacities, sh, color_slopes, view, center, lens, width, height,
    means2d, conic_ldl, z_out, colors, color_slopes2d, radii,
):  # fmt: skip
    # Writes one row of each output; culled: all zeros.
    num, num_sh = len(means), sh.shape[1]
    axes, turn, values = np.empty((3, 3)), np.empty((3, 3)), np.empty(16, f4)
    for g in range(block * BLOCK, min(num, (block + 1) * BLOCK)):
        means2d[g] = conic_ldl[g] = colors[g] = f4(0)
        color_slopes2d[g] = f4(0)
        z_out[g] = f4(0)
        radii[g] = 0
        wx, wy, wz, x, y, z = _center(view, means[g])
        if not z > NEAR_Z:  # False for NaN
            continue
        _, _, _, _, length = _axes(view, quats[g], scales[g], turn, axes)
        _, _, b0, b1, b2, c0, c1, c2 = _projected_axes(lens, x, y, z, axes)
        xx, xy, yy, det = _covariance(b0, b1, b2, c0, c1, c2)
        px, py = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]

        dx, dy, dz, _ = _direction(wx, wy, wz, center)
        _write_basis(f4(dx), f4(dy), f4(dz), num_sh, values)
        red, green, blue = _expansion(values, sh, g)
        # One sum notices every NaN and infinity.
        size = abs(px) + abs(py) + z + xx * yy + abs(red) + abs(green) + abs(blue) + abs(opacities[g])
        for i in range(3):
            size += abs(color_slopes[g, 0, i]) + abs(color_slopes[g, 1, i])  # a pixel adds at most 0.92 of it
        if not (size < OVERFLOW and length >= MIN_QUAT):
            continue
        means2d[g, 0], means2d[g, 1], z_out[g] = px, py, z
        conic_ldl[g, 0], conic_ldl[g, 1], conic_ldl[g, 2] = yy / det, -xy / yy, 1.0 / yy
        colors[g, 0], colors[g, 1], colors[g, 2] = max(red, f4(0)), max(green, f4(0)), max(blue, f4(0))
        x0, x1, y0, y1 = _local_per_px(xx, xy, yy, det, b0, b1, c0, c1)
        for i in range(3):
            color_slopes2d[g, 0, i] = x0 * color_slopes[g, 0, i] + x1 * color_slopes[g, 1, i]
            color_slopes2d[g, 1, i] = y0 * color_slopes[g, 0, i] + y1 * color_slopes[g, 1, i]
        if opacities[g] >= f4(ALPHA_MIN):
            level = 2.0 * np.log(opacities[g] / ALPHA_MIN)  # squared reach of the footprint, in sigmas
            reach_x, reach_y = np.sqrt(level * xx), np.sqrt(level * yy)
            if (
                px + reach_x >= 0.5 and px - reach_x <= width - 0.5
                and py + reach_y >= 0.5 and py - reach_y <= height - 0.5
            ):  # fmt: skip
                half = 0.5 * (xx - yy)
                long_axis = 0.5 * (xx + yy) + np.sqrt(half * half + xy * xy)
                radii[g] = np.int32(min(np.ceil(3.0 * np.sqrt(long_axis)), 2.0**30))


@parallel_njit(error_model="numpy")
def project_forward(means, *others):
    # One task per BLOCK Gaussians. Takes what `_project_block` does, which is apart because Numba infers the types of a
    # parallel loop's body twice; np.int64, because the second time the index is unsigned.
    for block in prange((len(means) + BLOCK - 1) // BLOCK):
        _project_block(np.int64(block), means, *others)


@njit(inline="always")
def _pull_color(values, sh, v_colors, g, v_values, v_sh):
    # Fills dL/d(harmonics) and, for Gaussian g, dL/d(coefficients); nothing passes a channel that is cut off at 0.
    red, green, blue = _expansion(values, sh, g)
    v_red = v_colors[g, 0] if red >= f4(0) else f4(0)
    v_green = v_colors[g, 1] if green >= f4(0) else f4(0)
    v_blue = v_colors[g, 2] if blue >= f4(0) else f4(0)
    for i in range(sh.shape[1]):
        v_values[i] = v_red * sh[g, i, 0] + v_green * sh[g, i, 1] + v_blue * sh[g, i, 2]
        v_sh[g, i, 0], v_sh[g, i, 1], v_sh[g, i, 2] = values[i] * v_red, values[i] * v_green, values[i] * v_blue


@njit(inline="always")
def _pull_axes(view, v_axes, turn, scales, v_turn, v_scales):
    # Fills dL/d(rotation) and dL/d(scales).
    for j in range(3):
        for i in range(3):
            v_turn[i, j] = view[0, i] * v_axes[0, j] + view[1, i] * v_axes[1, j] + view[2, i] * v_axes[2, j]
        v_scales[j] = v_turn[0, j] * turn[0, j] + v_turn[1, j] * turn[1, j] + v_turn[2, j] * turn[2, j]
        for i in range(3):
            v_turn[i, j] *= scales[j]


@njit(inline="always")
def _pull_turn(r, w, x, y, z):
    # dL/d(unit quaternion) from dL/d(rotation) = r.
    v_w = 2 * (x * (r[2, 1] - r[1, 2]) + y * (r[0, 2] - r[2, 0]) + z * (r[1, 0] - r[0, 1]))
    v_x = 2 * (y * (r[0, 1] + r[1, 0]) + z * (r[0, 2] + r[2, 0]) + w * (r[2, 1] - r[1, 2]))
    v_y = 2 * (x * (r[0, 1] + r[1, 0]) + z * (r[1, 2] + r[2, 1]) + w * (r[0, 2] - r[2, 0]))
    v_z = 2 * (x * (r[0, 2] + r[2, 0]) + y * (r[1, 2] + r[2, 1]) + w * (r[1, 0] - r[0, 1]))
    return v_w, v_x - 4 * x * (r[1, 1] + r[2, 2]), v_y - 4 * y * (r[0, 0] + r[2, 2]), v_z - 4 * z * (r[0, 0] + r[1, 1])


@njit(error_model="numpy")
def _pull_block(
    block, means, quats, scales, sh, color_slopes, view, center, lens, radii,
    v_means2d, v_conic_ldl, v_z, v_colors, v_color_slopes2d, v_means, v_quats, v_scales, v_sh, v_color_slopes,
):  # fmt: skip
    # Writes one row of each of the last five; zeros where radii is 0.
    num, num_sh = len(means), sh.shape[1]
    axes, turn, v_axes, v_turn = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    values, v_values = np.empty(16, f4), np.empty(16, f4)
    for g in range(block * BLOCK, min(num, (block + 1) * BLOCK)):
        if radii[g] == 0:
            v_means[g] = v_quats[g] = v_scales[g] = f4(0)
            v_sh[g] = v_color_slopes[g] = f4(0)
            continue
        wx, wy, wz, x, y, z = _center(view, means[g])
        qw, qx, qy, qz, length = _axes(view, quats[g], scales[g], turn, axes)
        slope_x, slope_y, b0, b1, b2, c0, c1, c2 = _projected_axes(lens, x, y, z, axes)
        xx, xy, yy, det = _covariance(b0, b1, b2, c0, c1, c2)

        # LDL^T factors -> covariance -> rows of J times the axes.
        v_a, v_k = np.float64(v_conic_ldl[g, 0]), np.float64(v_conic_ldl[g, 1])
        v_det = -v_a * yy / (det * det)
        v_xx = v_det * yy
        v_xy = -2.0 * v_det * xy - v_k / yy
        v_yy = -v_a * (xy / det) ** 2 + (v_k * xy - v_conic_ldl[g, 2]) / (yy * yy)

        # Slopes of the color, P^T times color_slopes with P = inverse covariance times b, c of two axes.
        x0, x1, y0, y1 = _local_per_px(xx, xy, yy, det, b0, b1, c0, c1)
        v_x0 = v_x1 = v_y0 = v_y1 = 0.0
        for i in range(3):
            along_x, along_y = np.float64(v_color_slopes2d[g, 0, i]), np.float64(v_color_slopes2d[g, 1, i])
            v_color_slopes[g, 0, i] = x0 * along_x + y0 * along_y
            v_color_slopes[g, 1, i] = x1 * along_x + y1 * along_y
            v_x0, v_x1 = v_x0 + along_x * color_slopes[g, 0, i], v_x1 + along_x * color_slopes[g, 1, i]
            v_y0, v_y1 = v_y0 + along_y * color_slopes[g, 0, i], v_y1 + along_y * color_slopes[g, 1, i]
        t_b0, t_c0 = (yy * v_x0 - xy * v_y0) / det, (xx * v_y0 - xy * v_x0) / det
        t_b1, t_c1 = (yy * v_x1 - xy * v_y1) / det, (xx * v_y1 - xy * v_x1) / det
        v_xx -= t_b0 * x0 + t_b1 * x1
        v_yy -= t_c0 * y0 + t_c1 * y1
        v_xy -= t_b0 * y0 + t_b1 * y1 + t_c0 * x0 + t_c1 * x1

        vb0, vb1, vb2 = 2 * v_xx * b0 + v_xy * c0, 2 * v_xx * b1 + v_xy * c1, 2 * v_xx * b2 + v_xy * c2
        vc0, vc1, vc2 = 2 * v_yy * c0 + v_xy * b0, 2 * v_yy * c1 + v_xy * b1, 2 * v_yy * c2 + v_xy * b2
        vb0, vb1, vc0, vc1 = vb0 + t_b0, vb1 + t_b1, vc0 + t_c0, vc1 + t_c1

        # Rows of J -> axes, slopes and depth.
        gx, gy = lens[0] / z, lens[1] / z
        v_axes[0, 0], v_axes[0, 1], v_axes[0, 2] = gx * vb0, gx * vb1, gx * vb2
        v_axes[1, 0], v_axes[1, 1], v_axes[1, 2] = gy * vc0, gy * vc1, gy * vc2
        for j in range(3):
            v_axes[2, j] = -slope_x * v_axes[0, j] - slope_y * v_axes[1, j]
        v_x = v_means2d[g, 0] * gx
        v_y = v_means2d[g, 1] * gy
        v_depth = v_z[g] - (v_x * x + v_y * y) / z
        v_depth -= (vb0 * b0 + vb1 * b1 + vb2 * b2 + vc0 * c0 + vc1 * c1 + vc2 * c2) / z
        if lens[4] <= x / z <= lens[5]:
            v_slope = -(v_axes[0, 0] * axes[2, 0] + v_axes[0, 1] * axes[2, 1] + v_axes[0, 2] * axes[2, 2])
            v_x += v_slope / z
            v_depth -= v_slope * x / (z * z)
        if lens[6] <= y / z <= lens[7]:
            v_slope = -(v_axes[1, 0] * axes[2, 0] + v_axes[1, 1] * axes[2, 1] + v_axes[1, 2] * axes[2, 2])
            v_y += v_slope / z
            v_depth -= v_slope * y / (z * z)

        # Color -> coefficients and direction of view -> mean.
        dx, dy, dz, inverse = _direction(wx, wy, wz, center)
        _write_basis(f4(dx), f4(dy), f4(dz), num_sh, values)
        _pull_color(values, sh, v_colors, g, v_values, v_sh)
        v_dx, v_dy, v_dz = _direction_gradient(f4(dx), f4(dy), f4(dz), num_sh, v_values)
        along = v_dx * dx + v_dy * dy + v_dz * dz
        v_means[g, 0] = view[0, 0] * v_x + view[1, 0] * v_y + view[2, 0] * v_depth + inverse * (v_dx - along * dx)
        v_means[g, 1] = view[0, 1] * v_x + view[1, 1] * v_y + view[2, 1] * v_depth + inverse * (v_dy - along * dy)
        v_means[g, 2] = view[0, 2] * v_x + view[1, 2] * v_y + view[2, 2] * v_depth + inverse * (v_dz - along * dz)

        # Axes = view R diag(scales) -> scales and R -> quaternion, through its normalization.
        _pull_axes(view, v_axes, turn, scales[g], v_turn, v_scales[g])
        v_w, v_qx, v_qy, v_qz = _pull_turn(v_turn, qw, qx, qy, qz)
        along = v_w * qw + v_qx * qx + v_qy * qy + v_qz * qz
        v_quats[g, 0], v_quats[g, 1] = (v_w - along * qw) / length, (v_qx - along * qx) / length
        v_quats[g, 2], v_quats[g, 3] = (v_qy - along * qy) / length, (v_qz - along * qz) / length


@parallel_njit(error_model="numpy")
def project_backward(means, *others):
    # One task per BLOCK Gaussians; takes what `_pull_block` does.
    for block in prange((len(means) + BLOCK - 1) // BLOCK):
        _pull_block(np.int64(block), means, *others)
