"""A stand-in for gsplat, written from its contracts, so that the GPU backend runs without a GPU.

It keeps gsplat's shapes, its bounds and its traps: it neither reads nor writes what it culls, and unwritten rows are
NaN.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

import numpy as np
import torch

from endoprior.render import sh as harmonics
from endoprior.render.projection import rotation_matrices

NAN = float("nan")
CAP, EDGE, STOP = 0.999, 1 / 255, 1e-4


def fully_fused_projection(
    means, covars, quats, scales, viewmats, Ks, width, height, *, eps2d, near_plane, far_plane, opacities
):
    """(B, 1, N, ...) radii int32 x and y, means2d, depths, conics, None; packed and compensations off."""
    moments = len(means)
    assert covars is None and viewmats.shape == (moments, 1, 4, 4) and Ks.shape == (moments, 1, 3, 3)
    assert not opacities.requires_grad and opacities.shape == means.shape[:2]
    each = [
        project_one(*one_of, width, height, eps2d, near_plane, far_plane)
        for one_of in zip(means, quats, scales, viewmats[:, 0], Ks[:, 0], opacities, strict=True)
    ]
    return *(torch.stack(parts)[:, None] for parts in zip(*each, strict=True)), None


def project_one(means, quats, scales, view, k, opacities, width, height, eps2d, near_plane, far_plane):
    """One camera's part of `fully_fused_projection`."""
    (fx, fy), (cx, cy) = k.diagonal()[:2], k[:2, 2]
    x, y, z = (means @ view[:3, :3].T + view[:3, 3]).unbind(-1)
    ahead = (z >= near_plane)[:, None]
    quats, scales = torch.where(ahead, quats, 1.0), torch.where(ahead, scales, 1.0)
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    slope_x = (x / z).clamp(-cx / fx - margin_x, (width - cx) / fx + margin_x)
    slope_y = (y / z).clamp(-cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    rows = [torch.stack([fx / z, zero, -fx * slope_x / z], -1), torch.stack([zero, fy / z, -fy * slope_y / z], -1)]
    spread = torch.stack(rows, -2) @ view[:3, :3] @ (rotation_matrices(quats) * scales[:, None, :])
    cov = spread @ spread.mT + eps2d * torch.eye(2)
    conic = torch.linalg.inv(cov)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    with torch.no_grad():
        extent = (2 * (opacities / EDGE).log()).sqrt().clamp(max=3.33)
        box = (extent[:, None] * cov.diagonal(dim1=-2, dim2=-1).sqrt()).ceil()
        size = torch.tensor([width, height])
        seen = (z >= near_plane) & (z <= far_plane) & (opacities >= EDGE)
        seen &= ((means2d + box > 0) & (means2d - box < size)).all(-1)
        radii = torch.where(seen[:, None], box, 0).int()
    unwritten = ~seen[:, None]
    conics = torch.stack([conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1]], -1)
    means2d, conics = means2d.masked_fill(unwritten, NAN), conics.masked_fill(unwritten, NAN)
    return radii, means2d, z.masked_fill(~seen, NAN), conics


def spherical_harmonics(degree, dirs, coeffs, masks=None):
    """(B, N, 3) sums; directions need not be unit vectors; rows masked out are never written."""
    assert masks.dtype == torch.bool and coeffs.shape == (*dirs.shape[:2], (degree + 1) ** 2, 3)
    dirs, coeffs = torch.where(masks[..., None], dirs, 1.0), torch.where(masks[..., None, None], coeffs, 0.0)
    values = harmonics.basis((dirs / dirs.norm(dim=-1, keepdim=True)).flatten(0, 1), degree).view(*coeffs.shape[:3])
    return (values[..., None] * coeffs).sum(2).masked_fill(~masks[..., None], NAN)


@torch.no_grad()
def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
    """Tiles per Gaussian (B, N), sorted 64-bit ids (picture, tile, bits of z), and the Gaussian of each (P,) int32."""
    ids, owners = [], []
    bits, (moments, num) = depths.contiguous().view(torch.int32).tolist(), depths.shape
    for m, n in torch.nonzero((radii > 0).all(-1)).tolist():
        low = ((means2d[m, n] - radii[m, n]) / tile_size).floor().long().clamp(min=0).tolist()
        high = ((means2d[m, n] + radii[m, n]) / tile_size).ceil().long().tolist()
        for row in range(low[1], min(high[1], tile_height)):
            for column in range(low[0], min(high[0], tile_width)):
                ids.append(((m * tile_height + row) * tile_width + column) << 32 | bits[m][n])
                owners.append(m * num + n)
    order = np.argsort(np.array(ids, np.int64), kind="stable")
    counts = torch.bincount(torch.tensor(owners, dtype=torch.int64), minlength=moments * num).int().view(moments, num)
    return counts, torch.tensor(ids, dtype=torch.int64)[order], torch.tensor(owners, dtype=torch.int32)[order]


@torch.no_grad()
def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    """(B, tile_height, tile_width) int32 where each tile's pairs begin."""
    tiles = torch.arange(n_images * tile_width * tile_height)
    return torch.searchsorted(isect_ids >> 32, tiles).int().view(n_images, tile_height, tile_width)


def rasterize_to_pixels(
    means2d, conics, colors, opacities, width, height, tile_size, isect_offsets, flatten_ids, backgrounds=None
):
    """(B, H, W, C) color and (B, H, W, 1) alpha, tile by tile."""
    channels, (moments, num) = colors.shape[-1], opacities.shape
    assert backgrounds is None and means2d.shape == (moments, num, 2) and conics.shape == (moments, num, 3)
    flat = [values.flatten(0, 1) for values in (means2d, conics, colors, opacities)]
    starts = isect_offsets.flatten(1).tolist()
    ends = [*(row[0] for row in starts[1:]), len(flatten_ids)]
    drawn = torch.stack(
        [
            pixels_of_one(*flat, width, height, tile_size, isect_offsets.shape[1:], [*row, end], flatten_ids)
            for row, end in zip(starts, ends, strict=True)
        ]
    )
    return drawn[..., :channels], drawn[..., channels:]


def pixels_of_one(means2d, conics, colors, opacities, width, height, tile_size, tiles_yx, ends, flatten_ids):
    """(H, W, C + 1) color and alpha of one picture."""
    rows = []
    for row in range(tiles_yx[0]):
        tiles = []
        for column in range(tiles_yx[1]):
            tile = row * tiles_yx[1] + column
            ids = flatten_ids[ends[tile] : ends[tile + 1]].long()
            ys = torch.arange(row * tile_size, min((row + 1) * tile_size, height)) + 0.5
            xs = torch.arange(column * tile_size, min((column + 1) * tile_size, width)) + 0.5
            pixels = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1)
            dx, dy = (means2d[ids] - pixels[:, :, None]).unbind(-1)
            a, b, c = conics[ids].unbind(-1)
            alpha = (opacities[ids] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(max=CAP)
            alpha = torch.where(alpha >= EDGE, alpha, 0)
            alpha = alpha * (torch.cumprod(1 - alpha.detach(), -1) > STOP)
            left = torch.cumprod(torch.cat([torch.ones(*alpha.shape[:2], 1), 1 - alpha], -1), -1)
            color = (alpha * left[..., :-1]) @ colors[ids]
            tiles.append(torch.cat([color, 1 - left[..., -1:]], -1))
        rows.append(torch.cat(tiles, 1))
    return torch.cat(rows)


def loaded(monkeypatch, kernels):
    """A fresh import of the backend with a gsplat whose compiled part is `kernels`."""
    fake = ModuleType("gsplat")
    functions = (fully_fused_projection, spherical_harmonics, isect_tiles, isect_offset_encode, rasterize_to_pixels)
    for function in functions:
        setattr(fake, function.__name__, function)
    for name, module in {"gsplat": fake, "gsplat.cuda": ModuleType("cuda"), "gsplat.cuda._backend": fake}.items():
        monkeypatch.setitem(sys.modules, name, module)
    fake._C = kernels
    forget(monkeypatch)
    module = importlib.import_module("endoprior.render.gsplat")
    monkeypatch.setattr(module, "DEVICE", "cpu")
    return module


def forget(monkeypatch):
    """Make the next import of the backend a real one, now and after the test."""
    monkeypatch.delitem(sys.modules, "endoprior.render.gsplat", raising=False)
    monkeypatch.setitem(sys.modules, "endoprior.render.gsplat", ModuleType("put aside"))  # undone last: nothing stays
    del sys.modules["endoprior.render.gsplat"]
