# pyright: reportCallIssue=false
"""What instruments are made of: color, gloss, printed marks and wear of a surface, and the light it returns.

A metal mirrors the tissue of the same image, blurred; plastic and paint do so only at grazing angles.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..compute.simd import REORDERED
from .shading import HIGHLIGHT_LIMIT, REFERENCE_MM, ggx


@dataclass(frozen=True)
class Material:
    """One surface of an instrument; colors are linear light in [0, 1]."""

    color: tuple[float, float, float]
    """Of light scattered back, or of the mirror image in a metal."""
    rough: float = 0.4
    """GGX roughness, 0.1..0.8."""
    diffuse: float = 1.0
    """Share of `color` that is scattered in all directions, 0..1."""
    mirror: float = 0.05
    """Share of the surroundings that is mirrored straight on, 0..1."""
    shine: float = 0.01
    """Strength of the light guides' highlights."""
    metal: float = 0.0
    """1: mirror image and highlights take on `color`."""
    waves: float = 0.0
    """Unevenness that breaks up reflections, 0..1."""
    weave: float = 0.0
    """Strength of the weave of a carbon composite, or of brush marks, 0..1."""
    mottle: float = 0.0
    """Strength of stains, 0..1."""
    wear: float = 0.0
    """Share of the surface that is scratched and scuffed, 0..1."""
    mark: tuple[float, float, float] = (0.8, 0.8, 0.8)
    """Color of rings and print."""
    rings: tuple[float, float, float, float] = (0, 1, 1, 0)
    """First place on the shaft, distance and width, mm, and number of printed rings."""
    print_at: tuple[float, float] = (0, 0)
    """First place on the shaft and length, mm, of two lines of print; length 0: none."""

    def row(self) -> NDArray[np.float32]:
        """(21,) its numbers, in the order of the fields."""
        return np.hstack(astuple(self)).astype(np.float32)


_ROUGH, _DIFFUSE, _MIRROR, _SHINE, _METAL, _WAVES, _WEAVE, _MOTTLE, _WEAR = 3, 4, 5, 6, 7, 8, 9, 10, 11
_MARK, _RINGS, _PRINT = 12, 15, 19
_DOT_MM, _PRINT_MM = 0.34, 2.0
"""Size of a dot of print; half the height of its two lines."""


@njit(cache=True)
def _hash(x, y):
    # 16 pseudo-random bits of two small integers.
    h = (x * 374761393 + y * 668265263 + 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return (h ^ (h >> 15)) & 0xFFFF


@njit(cache=True, fastmath=REORDERED)
def _marked(m, x, arc, seed):
    # Whether rings or print of material m (21,) cover the place x mm along the shaft and `arc` mm around it.
    u = x - m[_RINGS]
    k = np.floor(u / m[_RINGS + 1])
    if k >= np.float32(0) and k < m[_RINGS + 3] and u - k * m[_RINGS + 1] < m[_RINGS + 2]:
        return True
    u = x - m[_PRINT]
    if u < np.float32(0) or u >= m[_PRINT + 1] or abs(arc) >= np.float32(_PRINT_MM):
        return False
    # Glyphs of 3 x 5 dots in cells of 4 x 6; a sixth of the cells is empty, which parts words.
    column = int(u / np.float32(_DOT_MM))
    row = int((arc + np.float32(_PRINT_MM)) / np.float32(_DOT_MM))
    glyph, line, dot_x, dot_y = column // 4, row // 6, column % 4, row % 6
    if dot_x == 3 or dot_y == 5 or line > 1 or _hash(glyph, 7 * line + seed) % 6 == 0:
        return False
    # A full vertical stroke and some of the other dots look more like letters than dots alone.
    return dot_x == 0 or _hash(glyph * 4 + dot_x, line * 8 + dot_y + 64 * seed) % 5 < 2


@njit(cache=True, fastmath=REORDERED)
def _scuffed(x, around, phase, seed):
    # 0..1: how much of the coat is gone at x mm along the shaft and `around` rad: faint patches, and scratches.
    patch = np.sin(x * np.float32(0.43) + phase) * np.sin(around * np.float32(1.7) - x * np.float32(0.21))
    patch += np.float32(0.5) * np.sin(x * np.float32(1.9) + around * np.float32(4.1) + phase)
    patch += np.float32(0.5) * np.sin(x * np.float32(5.3) - around * np.float32(9.7)) * np.sin(x * np.float32(3.1))
    bare = np.float32(0.3) * min(max(np.float32(1.4) * (patch - np.float32(0.5)), np.float32(0)), np.float32(1))
    # One cell of 4 mm in four holds a slanted scratch, which is faint towards its ends.
    u, v = x / np.float32(4), around / np.float32(0.30)
    i, j = int(np.floor(u)), int(np.floor(v))
    h = _hash(i + 64, j + 64 + seed)
    if h % 4 == 0:
        u, v = u - np.float32(i + 0.5), v - np.float32(j + 0.5)
        off = abs(v - (np.float32(h % 97) / np.float32(97) - np.float32(0.5)) * np.float32(1.4) * u)
        line = max(np.float32(1) - off / np.float32(0.10), np.float32(0))
        bare = max(bare, line * (np.float32(1) - np.float32(2) * abs(u)))
    return bare


@njit(inline="always")
def _grain(m, x, around, phase):
    # About 1: how bright weave and stains make the surface.
    zero, one = np.float32(0), np.float32(1)
    grain = one
    if m[_WEAVE] > zero:
        twist = np.float32(1.9) * np.sin(x * np.float32(0.9) + around * np.float32(5))
        grain += m[_WEAVE] * (np.sin(around * np.float32(43) + twist) + np.float32(0.4) * np.sin(x * np.float32(9.5)))
    if m[_MOTTLE] > zero:
        slow = np.sin(x * np.float32(0.31) + phase) * np.sin(around * np.float32(2) + x * np.float32(0.17))
        fast = np.sin(x * np.float32(2.3) + around * np.float32(3))
        fast *= np.sin(x * np.float32(1.1) - around * np.float32(7))
        grain += m[_MOTTLE] * (np.float32(0.6) * slow + np.float32(0.4) * fast)
    return grain


@njit(cache=True, fastmath=REORDERED)
def paint_at(m, x, y, z, seed, n, out):
    # Surface of material m (21,) at (x, y, z) mm in the shaft's axes. Writes out (7,): color, roughness, diffuse and
    # mirrored shares, highlights; tilts the unit normal n (3,) by the unevenness.
    zero, one = np.float32(0), np.float32(1)
    for c in range(3):
        out[c] = m[c]
    out[3], out[4], out[5], out[6] = m[_ROUGH], m[_DIFFUSE], m[_MIRROR], m[_SHINE]
    around, phase = np.arctan2(z, y), np.float32(seed % 64)
    grain = _grain(m, x, around, phase)
    if m[_RINGS + 3] > zero or m[_PRINT + 1] > zero:
        if _marked(m, x, around * np.sqrt(y * y + z * z), seed):
            for c in range(3):
                out[c] = m[_MARK + c]
            out[4], out[5], out[6] = one, np.float32(0.03), np.float32(0.008)
    if m[_WEAR] > zero:
        bare = m[_WEAR] * _scuffed(x, around, phase, seed)
        for c in range(3):
            out[c] += bare * (np.float32(0.22) - out[c])
        out[5] += bare * np.float32(0.25)
    if m[_WAVES] > zero:
        wave = np.sin(x * np.float32(2.3) + np.float32(1.7) * np.sin(y * np.float32(1.9)))
        fine = np.sin(y * np.float32(7.1) + z * np.float32(5.3) - x * np.float32(6.1))
        n[0] += m[_WAVES] * (np.float32(0.10) * wave + np.float32(0.03) * fine)
        n[1] += m[_WAVES] * np.float32(0.09) * np.sin(y * np.float32(2.7) - x * np.float32(1.3))
        norm = one / np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        for c in range(3):
            n[c] *= norm
    for c in range(3):
        out[c] *= max(grain, np.float32(0.2))


@njit(cache=True, fastmath=REORDERED)
def radiance_at(n, v, p, paint, metal, seen, lights, out):
    # Radiance of a tool's point: position p mm, unit normal n, unit direction v to the camera, paint (7,) from
    # `paint_at`, the mirrored surroundings `seen` (3,); writes out (3,).
    zero, one = np.float32(0), np.float32(1)
    facing = max(n[0] * v[0] + n[1] * v[1] + n[2] * v[2], zero)
    fresnel = (one - facing) ** 5
    mirror = paint[5] + (one - paint[5]) * np.float32(0.4) * fresnel
    for c in range(3):
        out[c] = mirror * seen[c] * (one + metal * (paint[c] - one))
    for k in range(lights.shape[0]):
        lx, ly, lz = lights[k, 0] - p[0], lights[k, 1] - p[1], lights[k, 2] - p[2]
        square = lx * lx + ly * ly + lz * lz
        norm = one / np.sqrt(square)
        lx, ly, lz = lx * norm, ly * norm, lz * norm
        power = np.float32(REFERENCE_MM * REFERENCE_MM) / square * lz * lz * lz * lz * np.float32(0.5)
        lit = max(n[0] * lx + n[1] * ly + n[2] * lz, zero)
        hx, hy, hz = lx + v[0], ly + v[1], lz + v[2]
        norm = one / np.sqrt(hx * hx + hy * hy + hz * hz)
        half = max((n[0] * hx + n[1] * hy + n[2] * hz) * norm, zero)
        shine = ggx(half, paint[3]) * paint[6] * lit
        for c in range(3):
            out[c] += power * (paint[4] * paint[c] * lit + shine * (one + metal * (paint[c] - one)))
    for c in range(3):
        out[c] = min(out[c], np.float32(HIGHLIGHT_LIMIT))
