# pyright: reportCallIssue=false
"""Shape and light of `graspers`, the older pair: formulas instead of tables of parts keep their images bit-identical.

Kernels take a tool `g` as `instrument_tracing.pack` gives it; of materials only the colors count: collar, then shaft.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import REORDERED
from .instrument_shapes import cylinder
from .shading import HIGHLIGHT_LIMIT, REFERENCE_MM, ggx

JAW_MM = 13.0
"""Length of a jaw."""
_STEPS = 70
_TASKS = 64
_SHAFT_BOUND_MM, _JAW_BOUND_MM = 3.6, 11.0
"""Bounding radii: cylinder around shaft and collar, sphere around jaws and wrist."""


@njit(cache=True, fastmath=REORDERED)
def _jaw(x, y, z):
    # Signed distance to one jaw: a tapered rounded bar along x with an oval window; z is away from the other jaw.
    zero, half = np.float32(0), np.float32(0.5)
    f = min(max(x * np.float32(1 / JAW_MM), zero), np.float32(1))
    half_width = np.float32(2.1) - np.float32(0.9) * f * f
    thick = np.float32(1.55) - np.float32(0.75) * f
    r = np.float32(0.47) * thick
    qx = abs(x - np.float32(JAW_MM / 2 - 0.8)) - np.float32(JAW_MM / 2 + 0.8) + r
    qy = abs(y) - half_width + r
    qz = abs(z - half * thick - np.float32(0.06)) - half * thick + r
    ox, oy, oz = max(qx, zero), max(qy, zero), max(qz, zero)
    bar = np.sqrt(ox * ox + oy * oy + oz * oz) + min(max(qx, max(qy, qz)), zero) - r
    wx = x - min(max(x, np.float32(4.6)), np.float32(9.6))
    window = np.float32(0.62) - np.sqrt(wx * wx + y * y)
    return max(bar, window)


@njit(cache=True, fastmath=REORDERED)
def _distance(px, py, pz, g):
    # Signed distance, mm, from a point to a grasper, and its part: 0 shaft, 1 collar, 2 wrist and jaws.
    dx, dy, dz = px - g[0], py - g[1], pz - g[2]
    along = dx * g[3] + dy * g[4] + dz * g[5]
    square = dx * dx + dy * dy + dz * dz
    radial = np.sqrt(max(square - along * along, np.float32(0)))
    shaft = cylinder(along, radial, np.float32(9.5), np.float32(400), np.float32(3.25), np.float32(0.3))
    if along > np.float32(13):
        return shaft, 0  # the other parts are further away than the shaft's near end
    # The collar has two grooves.
    wave = np.cos((along - np.float32(5.2)) * np.float32(2.1)) - np.float32(0.55)
    groove = np.float32(0.22) * max(np.float32(0), wave)
    collar = cylinder(along, radial + groove, np.float32(4.8), np.float32(10), np.float32(3.3), np.float32(0.6))
    x = dx * g[12] + dy * g[13] + dz * g[14]
    y = dx * g[15] + dy * g[16] + dz * g[17]
    z = dx * g[18] + dy * g[19] + dz * g[20]
    # Wrist: two prongs of a tapering fork between collar and hinge, and the hinge's pin.
    taper = np.float32(2.0) + np.float32(0.17) * max(along, np.float32(0))
    fork = cylinder(along, radial, np.float32(-1.6), np.float32(6), taper, np.float32(0.7))
    fork = max(fork, np.float32(1.0) - abs(y))
    pin = cylinder(y, np.sqrt(x * x + z * z), np.float32(-2.5), np.float32(2.5), np.float32(1.15), np.float32(0.25))
    c, s = g[21], g[22]
    jaws = min(_jaw(c * x + s * z, y, c * z - s * x), _jaw(c * x - s * z, y, -c * z - s * x))
    metal = min(min(fork, pin), jaws)
    nearest, part = shaft, 0
    if collar < nearest:
        nearest, part = collar, 1
    if metal < nearest:
        nearest, part = metal, 2
    return nearest, part


@njit(cache=True, fastmath=REORDERED)
def _light(n, v, p, part, tints, lights, grain, out):
    # Radiance at position p with unit normal n towards unit direction v; writes out (3,).
    zero, one = np.float32(0), np.float32(1)
    facing = max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], zero)
    # Environment reflection: dark behind the camera, elsewhere lit organs as streaks of light and shade.
    rx = np.float32(2) * facing * n[0] - v[0]
    ry = np.float32(2) * facing * n[1] - v[1]
    rz = np.float32(2) * facing * n[2] - v[2]
    ahead = min(max(rz * np.float32(1.3) + np.float32(1.0), zero), one)
    streak = np.sin(np.float32(5.0) * rx + np.float32(1.5) * ry + np.float32(0.8)) * np.sin(np.float32(4.0) * ry - rx)
    streak = np.float32(0.12) + np.float32(1.1) * max(streak, zero) ** 2
    fresnel = (one - facing) ** 5
    rough, diffuse, mirror = np.float32(0.24), np.float32(0.07), np.float32(0.95)
    if part == 0:
        rough, diffuse, mirror = np.float32(0.42), np.float32(1), np.float32(0.05) + np.float32(0.35) * fresnel
    for c in range(3):
        tint = tints[c] if part < 2 else np.float32(0.72 - 0.02 * c)
        seen = ahead * streak * (np.float32(0.34) if c == 0 else np.float32(0.25)) + np.float32(0.006)
        out[c] = mirror * seen * (tint if part > 0 else one)
    for m in range(lights.shape[0]):
        lx, ly, lz = lights[m, 0] - p[0], lights[m, 1] - p[1], lights[m, 2] - p[2]
        square = lx * lx + ly * ly + lz * lz
        norm = one / np.sqrt(square)
        lx, ly, lz = lx * norm, ly * norm, lz * norm
        power = np.float32(REFERENCE_MM * REFERENCE_MM) / square * lz * lz * lz * lz * np.float32(0.5)
        lit = max(n[0] * lx + n[1] * ly + n[2] * lz, zero)
        hx, hy, hz = lx + v[0], ly + v[1], lz + v[2]
        norm = one / np.sqrt(hx * hx + hy * hy + hz * hz)
        half = max((n[0] * hx + n[1] * hy + n[2] * hz) * norm, zero)
        shine = ggx(half, rough) * (np.float32(0.010) if part == 0 else np.float32(0.085)) * lit
        for c in range(3):
            tint = tints[c] if part < 2 else np.float32(0.72 - 0.02 * c)
            out[c] += power * (diffuse * tint * grain * lit + shine * (one if part == 0 else tint))
    for c in range(3):
        out[c] = min(out[c], np.float32(HIGHLIGHT_LIMIT))


@njit(inline="always")
def _span(g, camera, rx, ry, rz):
    # Where the ray (rx, ry, rz) enters and leaves a cylinder around the shaft or a ball around the jaws.
    zero, one = np.float32(0), np.float32(1)
    mx, my, mz = camera[0] - g[0], camera[1] - g[1], camera[2] - g[2]
    ray_axis, camera_axis = rx * g[3] + ry * g[4] + rz * g[5], mx * g[3] + my * g[4] + mz * g[5]
    enter, leave = np.float32(1e9), np.float32(-1)
    qa = max(one - ray_axis * ray_axis, np.float32(1e-6))
    qb = mx * rx + my * ry + mz * rz - camera_axis * ray_axis
    qc = mx * mx + my * my + mz * mz - camera_axis * camera_axis - np.float32(_SHAFT_BOUND_MM**2)
    root = qb * qb - qa * qc
    if root > zero:
        root = np.sqrt(root)
        enter, leave = (-qb - root) / qa, (-qb + root) / qa
    mx, my, mz = mx - np.float32(6) * g[12], my - np.float32(6) * g[13], mz - np.float32(6) * g[14]
    qb = mx * rx + my * ry + mz * rz
    root = qb * qb - (mx * mx + my * my + mz * mz - np.float32(_JAW_BOUND_MM**2))
    if root > zero:
        root = np.sqrt(root)
        enter, leave = min(enter, -qb - root), max(leave, -qb + root)
    return enter, leave


@njit(inline="always")
def _paint(n, norm, p, part, g):
    # Makes the gradient n a unit normal, by `norm`, and roughens it at position p; returns how dark the shaft is there.
    one = np.float32(1)
    grain = one
    if part == 0:
        # Fine rings and streaks of the composite shaft.
        along = (p[0] - g[0]) * g[3] + (p[1] - g[1]) * g[4] + (p[2] - g[2]) * g[5]
        around = (n[0] * g[15] + n[1] * g[16] + n[2] * g[17]) * norm
        weave = np.float32(1.9) * np.sin(along * np.float32(0.9) + around * np.float32(5))
        grain += np.float32(0.14) * np.sin(around * np.float32(43) + weave)
        grain += np.float32(0.05) * np.sin(along * np.float32(9.5))
    for c in range(3):
        n[c] *= norm
    if part > 0:
        # Machining marks: a slight waviness that breaks up the reflections of flat faces.
        wave = np.sin(p[0] * np.float32(2.3) + np.float32(1.7) * np.sin(p[1] * np.float32(1.9)))
        mark = np.sin(p[1] * np.float32(7.1) + p[2] * np.float32(5.3) - p[0] * np.float32(6.1))
        n[0] += np.float32(0.10) * wave + np.float32(0.03) * mark
        n[1] += np.float32(0.09) * np.sin(p[1] * np.float32(2.7) - p[0] * np.float32(1.3))
        norm = one / np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        for c in range(3):
            n[c] *= norm
    return grain


@parallel_njit(fastmath=REORDERED)
def draw_graspers(tools, materials, tissue_z, camera, lights, focal, cx, cy, color, depth):
    # A task takes every 64th row, since tools fill only some rows. Sphere-traces each tool in front of the tissue
    # tissue_z (SH, SW), mm; writes color (SH, SW, 3) and depth (SH, SW), only where a tool is nearest.
    half, one = np.float32(0.5), np.float32(1)
    for task in prange(_TASKS):
        n, v = np.zeros(3, np.float32), np.zeros(3, np.float32)
        p, radiance = np.zeros(3, np.float32), np.zeros(3, np.float32)
        for s in range((depth.shape[0] - task + _TASKS - 1) // _TASKS * depth.shape[1]):
            i, j = task + s // depth.shape[1] * _TASKS, s % depth.shape[1]
            rx, ry = (np.float32(j) + half - cx) / focal, (np.float32(i) + half - cy) / focal
            norm = one / np.sqrt(rx * rx + ry * ry + one)
            rx, ry, rz = rx * norm, ry * norm, norm
            for k in range(tools.shape[0]):
                g = tools[k]
                enter, leave = _span(g, camera, rx, ry, rz)
                stop = min(min(tissue_z[i, j], depth[i, j]) / rz, leave)
                t, part, hit = max(enter, np.float32(8)), 0, False
                if t >= stop:
                    continue
                for _ in range(_STEPS):
                    d, part = _distance(camera[0] + t * rx, camera[1] + t * ry, camera[2] + t * rz, g)
                    if d < np.float32(0.012):
                        hit = True
                        break
                    t += np.float32(0.92) * d
                    if t > stop:
                        break
                if not hit or t >= stop:
                    continue
                p[0], p[1], p[2] = camera[0] + t * rx, camera[1] + t * ry, camera[2] + t * rz
                # Gradient of the distance from four corners of a small tetrahedron.
                e = np.float32(0.03)
                d0 = _distance(p[0] + e, p[1] - e, p[2] - e, g)[0]
                d1 = _distance(p[0] - e, p[1] - e, p[2] + e, g)[0]
                d2 = _distance(p[0] - e, p[1] + e, p[2] - e, g)[0]
                d3 = _distance(p[0] + e, p[1] + e, p[2] + e, g)[0]
                n[0], n[1], n[2] = d0 - d1 - d2 + d3, -d0 - d1 + d2 + d3, -d0 + d1 - d2 + d3
                norm = one / max(np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), np.float32(1e-9))
                grain = _paint(n, norm, p, part, g)
                v[0], v[1], v[2] = -rx, -ry, -rz
                _light(n, v, p, part, materials[int(g[23]) + (0 if part > 0 else 1)], lights, grain, radiance)
                depth[i, j] = t * rz
                for c in range(3):
                    color[i, j, c] = radiance[c]
