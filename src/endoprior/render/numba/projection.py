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

from ..constants import ALPHA_MIN, BLUR_PX2, MIN_QUAT, NEAR_Z, OVERFLOW
from .sh import direction_gradient, write_basis

f4 = np.float32
HALF = f4(0.5)
BLOCK = 256
"""Gaussians per task."""


@njit(inline="always")
def _axes(view, quat, scales, axes):
    # Fills axes (3, 3): columns are the Gaussian's axes in the camera frame, times their standard deviations.
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    for i in range(3):
        a, b, c = view[i, 0], view[i, 1], view[i, 2]
        axes[i, 0] = scales[0] * (a * (1 - 2 * (y * y + z * z)) + b * (2 * (x * y + w * z)) + c * (2 * (x * z - w * y)))
        axes[i, 1] = scales[1] * (a * (2 * (x * y - w * z)) + b * (1 - 2 * (x * x + z * z)) + c * (2 * (y * z + w * x)))
        axes[i, 2] = scales[2] * (a * (2 * (x * z + w * y)) + b * (2 * (y * z - w * x)) + c * (1 - 2 * (x * x + y * y)))
    return length


@njit(inline="always")
def _spread(lens, x, y, z, axes):
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


@njit(parallel=True, cache=True, error_model="numpy")
def project_forward(
    means, quats, scales, opacities, sh, color_slopes, view, center, lens, width, height,
    means2d, conic_ldl, z_out, colors, color_slopes2d, radii,
):  # fmt: skip
    # One task per BLOCK Gaussians. Writes one row of each output; culled: all zeros.
    num, num_sh = len(means), sh.shape[1]
    for block in prange((num + BLOCK - 1) // BLOCK):
        axes, values = np.empty((3, 3)), np.empty(16, f4)
        for g in range(block * BLOCK, min(num, (block + 1) * BLOCK)):
            means2d[g] = conic_ldl[g] = colors[g] = f4(0)
            color_slopes2d[g] = f4(0)
            z_out[g] = f4(0)
            radii[g] = 0
            wx, wy, wz = np.float64(means[g, 0]), np.float64(means[g, 1]), np.float64(means[g, 2])
            z = view[2, 0] * wx + view[2, 1] * wy + view[2, 2] * wz + view[2, 3]
            if not z > NEAR_Z:  # False for NaN
                continue
            x = view[0, 0] * wx + view[0, 1] * wy + view[0, 2] * wz + view[0, 3]
            y = view[1, 0] * wx + view[1, 1] * wy + view[1, 2] * wz + view[1, 3]
            length = _axes(view, quats[g], scales[g], axes)
            _, _, b0, b1, b2, c0, c1, c2 = _spread(lens, x, y, z, axes)
            xx, xy, yy, det = _covariance(b0, b1, b2, c0, c1, c2)
            px, py = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]

            dx, dy, dz = wx - center[0], wy - center[1], wz - center[2]
            inverse = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
            write_basis(f4(dx * inverse), f4(dy * inverse), f4(dz * inverse), num_sh, values)
            red = green = blue = HALF
            for i in range(num_sh):
                red += values[i] * sh[g, i, 0]
                green += values[i] * sh[g, i, 1]
                blue += values[i] * sh[g, i, 2]
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


@njit(parallel=True, cache=True, error_model="numpy")
def project_backward(
    means, quats, scales, sh, color_slopes, view, center, lens, radii,
    v_means2d, v_conic_ldl, v_z, v_colors, v_color_slopes2d, v_means, v_quats, v_scales, v_sh, v_color_slopes,
):  # fmt: skip
    # One task per BLOCK Gaussians. Writes one row of each of the last five; zeros where radii is 0.
    num, num_sh = len(means), sh.shape[1]
    for block in prange((num + BLOCK - 1) // BLOCK):
        axes, values, v_values = np.empty((3, 3)), np.empty(16, f4), np.empty(16, f4)
        v_axes, r = np.empty((3, 3)), np.empty((3, 3))
        for g in range(block * BLOCK, min(num, (block + 1) * BLOCK)):
            if radii[g] == 0:
                v_means[g] = v_quats[g] = v_scales[g] = f4(0)
                v_sh[g] = v_color_slopes[g] = f4(0)
                continue
            wx, wy, wz = np.float64(means[g, 0]), np.float64(means[g, 1]), np.float64(means[g, 2])
            x = view[0, 0] * wx + view[0, 1] * wy + view[0, 2] * wz + view[0, 3]
            y = view[1, 0] * wx + view[1, 1] * wy + view[1, 2] * wz + view[1, 3]
            z = view[2, 0] * wx + view[2, 1] * wy + view[2, 2] * wz + view[2, 3]
            length = _axes(view, quats[g], scales[g], axes)
            slope_x, slope_y, b0, b1, b2, c0, c1, c2 = _spread(lens, x, y, z, axes)
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
            v_axes[2, 0] = -slope_x * v_axes[0, 0] - slope_y * v_axes[1, 0]
            v_axes[2, 1] = -slope_x * v_axes[0, 1] - slope_y * v_axes[1, 1]
            v_axes[2, 2] = -slope_x * v_axes[0, 2] - slope_y * v_axes[1, 2]
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
            dx, dy, dz = wx - center[0], wy - center[1], wz - center[2]
            inverse = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
            write_basis(f4(dx), f4(dy), f4(dz), num_sh, values)
            red = green = blue = HALF
            for i in range(num_sh):
                red += values[i] * sh[g, i, 0]
                green += values[i] * sh[g, i, 1]
                blue += values[i] * sh[g, i, 2]
            v_red = v_colors[g, 0] if red >= f4(0) else f4(0)
            v_green = v_colors[g, 1] if green >= f4(0) else f4(0)
            v_blue = v_colors[g, 2] if blue >= f4(0) else f4(0)
            for i in range(num_sh):
                v_values[i] = v_red * sh[g, i, 0] + v_green * sh[g, i, 1] + v_blue * sh[g, i, 2]
                v_sh[g, i, 0], v_sh[g, i, 1], v_sh[g, i, 2] = values[i] * v_red, values[i] * v_green, values[i] * v_blue
            v_dx, v_dy, v_dz = direction_gradient(f4(dx), f4(dy), f4(dz), num_sh, v_values)
            along = v_dx * dx + v_dy * dy + v_dz * dz
            v_means[g, 0] = view[0, 0] * v_x + view[1, 0] * v_y + view[2, 0] * v_depth + inverse * (v_dx - along * dx)
            v_means[g, 1] = view[0, 1] * v_x + view[1, 1] * v_y + view[2, 1] * v_depth + inverse * (v_dy - along * dy)
            v_means[g, 2] = view[0, 2] * v_x + view[1, 2] * v_y + view[2, 2] * v_depth + inverse * (v_dz - along * dz)

            # Axes = view R diag(scales) -> scales and R (r holds dL/dR) -> quaternion, through its normalization.
            w, qx, qy, qz = quats[g, 0] / length, quats[g, 1] / length, quats[g, 2] / length, quats[g, 3] / length
            for j in range(3):
                for i in range(3):
                    r[i, j] = view[0, i] * v_axes[0, j] + view[1, i] * v_axes[1, j] + view[2, i] * v_axes[2, j]
            v_scales[g, 0] = (
                r[0, 0] * (1 - 2 * (qy * qy + qz * qz)) + r[1, 0] * 2 * (qx * qy + w * qz)
                + r[2, 0] * 2 * (qx * qz - w * qy)
            )  # fmt: skip
            v_scales[g, 1] = (
                r[0, 1] * 2 * (qx * qy - w * qz) + r[1, 1] * (1 - 2 * (qx * qx + qz * qz))
                + r[2, 1] * 2 * (qy * qz + w * qx)
            )  # fmt: skip
            v_scales[g, 2] = (
                r[0, 2] * 2 * (qx * qz + w * qy) + r[1, 2] * 2 * (qy * qz - w * qx)
                + r[2, 2] * (1 - 2 * (qx * qx + qy * qy))
            )  # fmt: skip
            for j in range(3):
                for i in range(3):
                    r[i, j] *= scales[g, j]
            v_w = 2 * (qx * (r[2, 1] - r[1, 2]) + qy * (r[0, 2] - r[2, 0]) + qz * (r[1, 0] - r[0, 1]))
            v_qx = 2 * (qy * (r[0, 1] + r[1, 0]) + qz * (r[0, 2] + r[2, 0]) + w * (r[2, 1] - r[1, 2]))
            v_qx -= 4 * qx * (r[1, 1] + r[2, 2])
            v_qy = 2 * (qx * (r[0, 1] + r[1, 0]) + qz * (r[1, 2] + r[2, 1]) + w * (r[0, 2] - r[2, 0]))
            v_qy -= 4 * qy * (r[0, 0] + r[2, 2])
            v_qz = 2 * (qx * (r[0, 2] + r[2, 0]) + qy * (r[1, 2] + r[2, 1]) + w * (r[1, 0] - r[0, 1]))
            v_qz -= 4 * qz * (r[0, 0] + r[1, 1])
            along = v_w * w + v_qx * qx + v_qy * qy + v_qz * qz
            v_quats[g, 0], v_quats[g, 1] = (v_w - along * w) / length, (v_qx - along * qx) / length
            v_quats[g, 2], v_quats[g, 3] = (v_qy - along * qy) / length, (v_qz - along * qz) / length
