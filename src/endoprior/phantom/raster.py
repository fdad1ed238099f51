# pyright: reportCallIssue=false
"""Rasterize the deformed mesh: material coordinates and depth of each image sample.

Letters: (MH, MW) mesh vertices, (SH, SW) image samples; sample (i, j) is centered at (j + 0.5, i + 0.5).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from ..compute.parallel_kernels import parallel_njit
from ..compute.simd import REORDERED

_BANDS = 16
_RIM = np.float32(1e-4)  # triangles are widened by this, so that samples on a shared edge belong to one of the two
_NEAR_MM = 2.0
"""Vertices nearer than this, or behind the camera, are not drawn."""
FAR = np.float32(1e9)
"""Depth of samples without a surface."""


@njit(inline="always")
def _fill(corners, indices, box, mesh_w, mesh_h, out):
    # Draws one triangle where it is nearest. corners: x, y, then 1/z of each, 1 / area; indices: row, column of each.
    half, one = np.float32(0.5), np.float32(1)
    ax, ay, bx, by, cx, cy, wa, wb, wc, scale = corners
    ia, ja, ib, jb, ic, jc = indices
    left, right, first, last = box
    for py in range(first, last + 1):
        sy = np.float32(py) + half
        for px in range(left, right + 1):
            sx = np.float32(px) + half
            la = ((bx - sx) * (cy - sy) - (by - sy) * (cx - sx)) * scale
            lb = ((cx - sx) * (ay - sy) - (cy - sy) * (ax - sx)) * scale
            lc = one - la - lb
            if la < -_RIM or lb < -_RIM or lc < -_RIM:
                continue
            w = la * wa + lb * wb + lc * wc
            z = one / w
            if z < out[py, px, 2]:
                u = (la * wa * np.float32(ja) + lb * wb * np.float32(jb) + lc * wc * np.float32(jc)) * z
                v = (la * wa * np.float32(ia) + lb * wb * np.float32(ib) + lc * wc * np.float32(ic)) * z
                out[py, px, 0] = u / np.float32(mesh_w - 1)
                out[py, px, 1] = v / np.float32(mesh_h - 1)
                out[py, px, 2] = z


@parallel_njit(fastmath=REORDERED)
def _rasterize(x, y, inverse_z, row_low, row_high, out):
    # One task per band of image rows; it walks the mesh in a fixed order and keeps the nearest triangle of each sample.
    # x, y, inverse_z (MH, MW) projected vertices, px and 1/mm (0: not to be drawn); row_low/high (MH - 1,) y range of
    # each mesh row.
    # Writes out (SH, SW, 3): g_u, g_v, z. The plane equations of u/z, v/z, 1/z make it perspective-correct.
    height, width = out.shape[0], out.shape[1]
    mesh_h, mesh_w = x.shape
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    for band in prange(_BANDS):
        y0, y1 = band * height // _BANDS, (band + 1) * height // _BANDS
        for i in range(mesh_h - 1):
            if row_high[i] < y0 or row_low[i] > y1:
                continue
            for j in range(mesh_w - 1):
                for t in range(2):
                    ia, ja = i, j
                    ib, jb = (i + 1, j + 1) if t == 0 else (i + 1, j)
                    ic, jc = (i, j + 1) if t == 0 else (i + 1, j + 1)
                    wa, wb, wc = inverse_z[ia, ja], inverse_z[ib, jb], inverse_z[ic, jc]
                    if wa == zero or wb == zero or wc == zero:
                        continue
                    ax, ay, bx, by, cx, cy = x[ia, ja], y[ia, ja], x[ib, jb], y[ib, jb], x[ic, jc], y[ic, jc]
                    low, high = min(ay, by, cy), max(ay, by, cy)
                    first, last = max(y0, int(np.ceil(low - half))), min(y1 - 1, int(np.floor(high - half)))
                    if first > last:
                        continue
                    left = max(0, int(np.ceil(min(ax, bx, cx) - half)))
                    right = min(width - 1, int(np.floor(max(ax, bx, cx) - half)))
                    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
                    if left > right or area == zero:
                        continue
                    corners = ax, ay, bx, by, cx, cy, wa, wb, wc, one / area
                    _fill(corners, (ia, ja, ib, jb, ic, jc), (left, right, first, last), mesh_w, mesh_h, out)


def rasterize(
    vertices: NDArray, focal: float, center: tuple[float, float], width: int, height: int
) -> NDArray[np.float32]:
    """(height, width, 3): g_u, g_v in [0, 1] and z in mm of the nearest surface; z = FAR where there is none.

    Args:
        vertices: (MH, MW, 3) camera-space mesh, mm; what is behind the camera is left out.
        focal, center: px of the sample grid.
    """
    z = vertices[..., 2]
    inverse_z = np.divide(1, z, out=np.zeros_like(z), where=z > _NEAR_MM)
    x = (focal * vertices[..., 0] * inverse_z + center[0]).astype(np.float32)
    y = (focal * vertices[..., 1] * inverse_z + center[1]).astype(np.float32)
    low, high = y.min(1), y.max(1)
    out = np.zeros((height, width, 3), np.float32)
    out[..., 2] = FAR
    rows = np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])
    _rasterize(x, y, inverse_z.astype(np.float32), *rows, out)
    return out


def vertex_normals(vertices: NDArray) -> NDArray[np.float32]:
    """(MH, MW, 3) unit normals of the mesh, pointing towards the camera side (z < 0 for a flat wall)."""
    across, down = np.gradient(vertices, axis=1), np.gradient(vertices, axis=0)
    normal = np.cross(down, across)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
