"""Shapes of instruments: a table of primitives, and the signed distance to their union.

An instrument is a list of parts in its own axes, mm. x runs along the part: in the shaft's axes away from the tip, in
those of the jaws towards the tip; the origin of both is the wrist. y is the hinge, which points roughly to the camera.
A part is one row of `COLUMNS` numbers, in the order of the arguments of `tube`, `bar`, `pin` and `rod`.
"""

from __future__ import annotations

from math import hypot, pi

import numpy as np
from numba import njit

from ..compute.simd import REORDERED

SHAFT, JAWS, UPPER, LOWER = 0, 1, 2, 3
"""The axes a part is in: those of the shaft, of the jaws, of one jaw turned by half the opening, and of the other."""
COLUMNS = 17
"""Kind, axes, material, 13 numbers of the kind, and a factor that makes its formula at most the distance."""
_TUBE, _BAR, _PIN, _ROD = 0, 1, 2, 3
Part = tuple[float, ...]


def tube(
    axes: int,
    material: int,
    span: tuple[float, float],
    radii: tuple[float, float],
    rounding: float = 0.3,
    bore: float = 0.0,
    slot: float = 0.0,
    holes: tuple[float, float, float, float] = (0, 0, 0, 0),
    grooves: tuple[float, float] = (0, 0),
) -> Part:
    """A part round about x, cylindrical or tapered.

    Args:
        span: where it begins and ends on x, mm. radii: there, mm. rounding: radius of its rims, mm.
        bore: radius of the bore, mm; 0: solid. slot: half the width of a cut through its middle, across y, mm.
        holes: count, radius, first and distance of side holes along x, mm.
        grooves: depth and distance of grooves around it, mm.
    """
    slope = (radii[1] - radii[0]) / (span[1] - span[0])
    return (_TUBE, axes, material, *span, *radii, rounding, bore, slot, *holes, *grooves, _share(slope))


def bar(
    axes: int,
    material: int,
    span: tuple[float, float],
    half_widths: tuple[float, float],
    thickness: tuple[float, float],
    rounding: float = 0.5,
    lift: float = 0.0,
    bend: tuple[float, float] = (0, 0),
    window: tuple[float, float, float] = (0, 0, 0),
) -> Part:
    """A flat part along x: wide across y, thick towards z.

    Args:
        span: where it begins and ends on x, mm. half_widths, thickness: there, mm.
        rounding: radius of its edges as a share of half the thickness, 0..1. lift: z of its inner face, mm.
        bend: how far its end is off to y and z, mm; the way there is a parabola.
        window: half width, mm, and span on x of an oval opening; 0: none.
    """
    slope = (2 * hypot(*bend) + abs(half_widths[1] - half_widths[0])) / (span[1] - span[0])
    return (_BAR, axes, material, *span, *half_widths, *thickness, rounding, lift, *bend, *window, _share(slope))


def pin(axes: int, material: int, place: float, radius: float, half_length: float) -> Part:
    """A pin along y at x = `place`, mm."""
    return (_PIN, axes, material, place, radius, half_length, *[0.0] * 10, 1.0)


def rod(axes: int, material: int, start: tuple, stop: tuple, radii: tuple[float, float]) -> Part:
    """A round-ended rod from `start` to `stop`, (3,) mm each, with a radius at either end, mm."""
    return (_ROD, axes, material, *start, *stop, *radii, *[0.0] * 5, 1.0)


def _share(slope: float) -> float:
    """By how much a surface with this slope against x is nearer than the formula, which measures across x."""
    return 1 / hypot(1, slope)


@njit(cache=True, fastmath=REORDERED)
def cylinder(along, radial, start, stop, radius, rounding):
    # Signed distance to a cylinder between `start` and `stop` on its axis, with rounded rims.
    dx = radial - radius + rounding
    dy = abs(along - np.float32(0.5) * (start + stop)) - np.float32(0.5) * (stop - start) + rounding
    ox, oy = max(dx, np.float32(0)), max(dy, np.float32(0))
    return np.sqrt(ox * ox + oy * oy) + min(max(dx, dy), np.float32(0)) - rounding


@njit(cache=True, fastmath=REORDERED)
def _tube(p, x, y, z):
    zero, one = np.float32(0), np.float32(1)
    radial = np.sqrt(y * y + z * z)
    f = min(max((x - p[3]) / (p[4] - p[3]), zero), one)
    wide = p[5] + (p[6] - p[5]) * f
    if p[14] > zero:
        wave = np.cos((x - p[3]) * np.float32(2 * pi) / p[15]) - np.float32(0.55)
        radial = radial + p[14] * max(zero, wave)
    d = cylinder(x, radial, p[3], p[4], wide, p[7])
    if p[8] > zero:
        d = max(d, p[8] - radial)
    if p[9] > zero:
        d = max(d, p[9] - abs(y))
    if p[10] > zero:
        k = np.floor((x - p[12]) / p[13] + np.float32(0.5))
        u = x - p[12] - p[13] * min(max(k, zero), p[10] - one)
        d = max(d, p[11] - np.sqrt(u * u + min(y * y, z * z)))
    return d * p[16]


@njit(cache=True, fastmath=REORDERED)
def _bar(p, x, y, z):
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    f = min(max((x - p[3]) / (p[4] - p[3]), zero), one)
    y, z = y - p[11] * f * f, z - p[12] * f * f
    thick = half * (p[7] + (p[8] - p[7]) * f)
    r = p[9] * thick
    qx = abs(x - half * (p[3] + p[4])) - half * (p[4] - p[3]) + r
    qy = abs(y) - (p[5] + (p[6] - p[5]) * f) + r
    qz = abs(z - p[10] - thick) - thick + r
    ox, oy, oz = max(qx, zero), max(qy, zero), max(qz, zero)
    d = np.sqrt(ox * ox + oy * oy + oz * oz) + min(max(qx, max(qy, qz)), zero) - r
    if p[13] > zero:
        wx = x - min(max(x, p[14]), p[15])
        d = max(d, p[13] - np.sqrt(wx * wx + y * y))
    return d * p[16]


@njit(cache=True, fastmath=REORDERED)
def _rod(p, x, y, z):
    ax, ay, az = p[6] - p[3], p[7] - p[4], p[8] - p[5]
    qx, qy, qz = x - p[3], y - p[4], z - p[5]
    f = (qx * ax + qy * ay + qz * az) / (ax * ax + ay * ay + az * az)
    f = min(max(f, np.float32(0)), np.float32(1))
    qx, qy, qz = qx - f * ax, qy - f * ay, qz - f * az
    return np.sqrt(qx * qx + qy * qy + qz * qz) - p[9] - (p[10] - p[9]) * f


@njit(cache=True, fastmath=REORDERED)
def _one_distance(p, x, y, z):
    kind = p[0]
    if kind == np.float32(_TUBE):
        return _tube(p, x, y, z)
    if kind == np.float32(_BAR):
        return _bar(p, x, y, z)
    if kind == np.float32(_PIN):
        return cylinder(y, np.sqrt((x - p[3]) ** 2 + z * z), -p[5], p[5], p[4], np.float32(0.25))
    return _rod(p, x, y, z)


@njit(cache=True, fastmath=REORDERED)
def distance(px, py, pz, g, parts):
    # Signed distance, mm, from a point in camera axes to the tool g (see `instrument_tracing.pack`), whose parts are
    # parts[first:last]; and the index of the nearest part. Tapers and bends make it a bound, not exact.
    dx, dy, dz = px - g[0], py - g[1], pz - g[2]
    x = dx * g[3] + dy * g[4] + dz * g[5]
    y = dx * g[6] + dy * g[7] + dz * g[8]
    z = dx * g[9] + dy * g[10] + dz * g[11]
    first, last = int(g[23]), int(g[24])
    jx, jy, jz = np.float32(0), np.float32(0), np.float32(0)
    if x > g[26]:
        last = first + int(g[25])  # only parts of the shaft, which come first, reach beyond
    else:
        jx = dx * g[12] + dy * g[13] + dz * g[14]
        jy = dx * g[15] + dy * g[16] + dz * g[17]
        jz = dx * g[18] + dy * g[19] + dz * g[20]
    c, s = g[21], g[22]
    near, index = np.float32(1e9), first
    for k in range(first, last):
        p = parts[k]
        if p[1] == np.float32(SHAFT):
            d = _one_distance(p, x, y, z)
        elif p[1] == np.float32(JAWS):
            d = _one_distance(p, jx, jy, jz)
        elif p[1] == np.float32(UPPER):
            d = _one_distance(p, c * jx + s * jz, jy, c * jz - s * jx)
        else:
            d = _one_distance(p, c * jx - s * jz, jy, -c * jz - s * jx)
        if d < near:
            near, index = d, k
    return near, index
