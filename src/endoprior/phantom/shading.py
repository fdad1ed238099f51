# pyright: reportCallIssue=false
"""Shading of wet tissue: two light guides next to the lens, inverse-square falloff, diffuse light, highlights.

Wrapped diffuse lighting, stronger in red, approximates subsurface scattering. Highlights are GGX lobes with a normal
perturbed by the fine relief.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import REORDERED
from .camera import CameraPose
from .raster import FAR

LIGHTS_MM = np.array([[-3.6, -2.2, 0.0], [3.9, -1.8, 0.0]], np.float32)
"""(2, 3) light guides in the left camera's axes, mm."""
REFERENCE_MM = 75.0
"""Distance at which each light has unit irradiance."""
HIGHLIGHT_LIMIT = 3.0
"""Radiance of a sample is clamped to this, so that one highlight does not dominate a whole pixel."""


@njit(cache=True, fastmath=REORDERED, inline="always")
def ggx(cosine, alpha):
    # Microfacet distribution of roughness alpha at the cosine between normal and half vector.
    square = alpha * alpha
    d = cosine * cosine * (square - np.float32(1)) + np.float32(1)
    return square / (np.float32(np.pi) * d * d)


@parallel_njit(fastmath=REORDERED)
def _shade(hits, normals, texture, e_a, e_b, camera, turn, viewer, lights, focal, cx, cy, far, wet, out):
    # One task per row of samples. hits (SH, SW, 3) from `rasterize`; normals (MH, MW, 3); texture (TH, TW, 7); writes
    # out (SH, SW, 3) linear radiance. Both look-ups are bilinear; black where nothing was hit.
    mesh_h, mesh_w = normals.shape[:2]
    tex_h, tex_w = texture.shape[:2]
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    for i in prange(hits.shape[0]):
        t = np.zeros(7, np.float32)
        n = np.zeros(3, np.float32)
        for j in range(hits.shape[1]):
            z = hits[i, j, 2]
            if z >= far:
                out[i, j, 0] = out[i, j, 1] = out[i, j, 2] = zero
                continue
            gx, gy = hits[i, j, 0] * np.float32(mesh_w - 1), hits[i, j, 1] * np.float32(mesh_h - 1)
            ix, iy = min(int(gx), mesh_w - 2), min(int(gy), mesh_h - 2)
            fx, fy = gx - np.float32(ix), gy - np.float32(iy)
            for k in range(3):
                top = normals[iy, ix, k] * (one - fx) + normals[iy, ix + 1, k] * fx
                low = normals[iy + 1, ix, k] * (one - fx) + normals[iy + 1, ix + 1, k] * fx
                n[k] = top * (one - fy) + low * fy
            gx = min(max(hits[i, j, 0] * np.float32(tex_w) - half, zero), np.float32(tex_w) - np.float32(1.001))
            gy = min(max(hits[i, j, 1] * np.float32(tex_h) - half, zero), np.float32(tex_h) - np.float32(1.001))
            ix, iy = int(gx), int(gy)
            fx, fy = gx - np.float32(ix), gy - np.float32(iy)
            for k in range(7):
                top = texture[iy, ix, k] * (one - fx) + texture[iy, ix + 1, k] * fx
                low = texture[iy + 1, ix, k] * (one - fx) + texture[iy + 1, ix + 1, k] * fx
                t[k] = top * (one - fy) + low * fy
            # Position in the left camera's axes, which also carry the lights.
            rx, ry = (np.float32(j) + half - cx) / focal * z, (np.float32(i) + half - cy) / focal * z
            px = turn[0, 0] * rx + turn[0, 1] * ry + turn[0, 2] * z + camera[0]
            py = turn[1, 0] * rx + turn[1, 1] * ry + turn[1, 2] * z + camera[1]
            pz = turn[2, 0] * rx + turn[2, 1] * ry + turn[2, 2] * z + camera[2]
            # Bend the normal by the relief: tangents are the plane's axes laid onto the surface.
            da = n[0] * e_a[0] + n[1] * e_a[1] + n[2] * e_a[2]
            db = n[0] * e_b[0] + n[1] * e_b[1] + n[2] * e_b[2]
            bx = n[0] - t[3] * (e_a[0] - da * n[0]) - t[4] * (e_b[0] - db * n[0])
            by = n[1] - t[3] * (e_a[1] - da * n[1]) - t[4] * (e_b[1] - db * n[1])
            bz = n[2] - t[3] * (e_a[2] - da * n[2]) - t[4] * (e_b[2] - db * n[2])
            norm = one / np.sqrt(bx * bx + by * by + bz * bz)
            bx, by, bz = bx * norm, by * norm, bz * norm
            vx, vy, vz = viewer[0] - px, viewer[1] - py, viewer[2] - pz
            norm = one / np.sqrt(vx * vx + vy * vy + vz * vz)
            vx, vy, vz = vx * norm, vy * norm, vz * norm
            open_ = t[6]
            red, green, blue = zero, zero, zero
            for m in range(lights.shape[0]):
                lx, ly, lz = lights[m, 0] - px, lights[m, 1] - py, lights[m, 2] - pz
                square = lx * lx + ly * ly + lz * lz
                norm = one / np.sqrt(square)
                lx, ly, lz = lx * norm, ly * norm, lz * norm
                # The guides' cone: full in the middle, dim towards the corners of the image.
                beam = lz * lz
                power = np.float32(REFERENCE_MM * REFERENCE_MM) / square * beam * beam * half
                bent = bx * lx + by * ly + bz * lz
                broad = n[0] * lx + n[1] * ly + n[2] * lz
                cosine = np.float32(0.75) * bent + np.float32(0.25) * broad
                wrap_r = max(cosine + np.float32(0.22), zero) / np.float32(1.22)
                wrap_g = max(cosine + np.float32(0.08), zero) / np.float32(1.08)
                hx, hy, hz = lx + vx, ly + vy, lz + vz
                norm = one / np.sqrt(hx * hx + hy * hy + hz * hz)
                facing = max((bx * hx + by * hy + bz * hz) * norm, zero)
                level = max((n[0] * hx + n[1] * hy + n[2] * hz) * norm, zero)
                film = ggx(facing, np.float32(0.085)) * np.float32(0.0125)
                film += ggx(facing, np.float32(0.26)) * np.float32(0.020)
                sheen = ggx(level, np.float32(0.42)) * np.float32(0.012)
                shine = (film * t[5] * wet + sheen) * max(bent, zero) * open_
                red += power * (t[0] * wrap_r * open_ + shine)
                # Light that reaches a crease has bounced off red tissue, so green and blue fade faster there.
                green += power * (t[1] * wrap_g * open_ * (np.float32(0.6) + np.float32(0.4) * open_) + shine)
                blue += power * (t[2] * wrap_g * open_ * (np.float32(0.62) + np.float32(0.38) * open_) + shine)
            limit = np.float32(HIGHLIGHT_LIMIT)
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = min(red, limit), min(green, limit), min(blue, limit)


def shade(
    hits: NDArray[np.float32],
    normals: NDArray[np.float32],
    texture: NDArray[np.float32],
    axes: NDArray[np.float64],
    pose: CameraPose,
    viewer: NDArray[np.float64],
    focal: float,
    center: tuple[float, float],
    *,
    highlights: bool = True,
) -> NDArray[np.float32]:
    """(SH, SW, 3) linear radiance of the tissue at every sample of `hits`.

    Args:
        hits: (SH, SW, 3) from `raster.rasterize`, as `pose` sees them.
        normals: (MH, MW, 3) unit vertex normals.
        texture: (TH, TW, 7) material maps.
        axes: (2, 3) e_a and e_b of the tissue's plane in the axes of the left camera.
        pose: the camera; the lights stay with the left one. viewer: (3,) mm, where the light goes to.
        focal, center: of the sample grid, px.
        highlights: False leaves those of the wet film out; the broad sheen stays.
    """
    out = np.empty_like(hits)
    e_a, e_b = np.ascontiguousarray(axes, np.float32)
    f, cx, cy = (np.float32(value) for value in (focal, *center))
    center_mm, turn = pose.center.astype(np.float32), np.ascontiguousarray(pose.rotation, np.float32)
    seen_from, wet = viewer.astype(np.float32), np.float32(highlights)
    _shade(hits, normals, texture, e_a, e_b, center_mm, turn, seen_from, LIGHTS_MM, f, cx, cy, FAR, wet, out)
    return out
