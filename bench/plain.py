"""A tiled rasterizer in plain PyTorch, differentiated by autograd: what the kernels are compared with.

Same results as the package up to rounding (`tests/test_bench.py`). Shared letters: `N` Gaussians, `P` pairs of a tile
and a Gaussian in it, `L` tiles.
"""

from __future__ import annotations

from math import log
from typing import NamedTuple

import torch
from torch import Tensor

from endoprior.core.types import Camera, RenderOutput, Splats
from endoprior.render.constants import ALPHA_MAX, ALPHA_MIN, STOP_TRANSMITTANCE
from endoprior.render.projection import Projected, project

TILE = 16
"""Side of a tile, px."""
MIN_POWER = -20.0
"""Powers below this change nothing: alpha is under ALPHA_MIN long before."""


class Bins(NamedTuple):
    """Which Gaussians to draw in which tile, near to far."""

    ids: Tensor
    """(P,) Gaussians, tile by tile."""
    counts: list[int]
    """(L,) pairs of each tile."""


@torch.no_grad()
def bin_tiles(seen: Projected, opacities: Tensor, width: int, height: int) -> Bins:
    """Pairs of tiles with the Gaussians whose box around {alpha >= ALPHA_MIN} touches them, sorted by tile, then z."""
    tiles = torch.tensor([-(-width // TILE), -(-height // TILE)])
    reach = (2 * torch.log((opacities / ALPHA_MIN).clamp(min=1))).sqrt()
    box = reach[:, None] * seen.cov2d[:, ::2].sqrt()
    first = ((seen.means2d - box) / TILE).floor().long().clamp(min=0)
    end = torch.minimum(((seen.means2d + box) / TILE).floor().long() + 1, tiles)
    across, down = ((end - first).clamp(min=0) * (seen.radii > 0)[:, None]).unbind(-1)
    near_to_far = seen.z.argsort(stable=True)
    count = (across * down)[near_to_far]
    ids = near_to_far.repeat_interleave(count)
    place = torch.arange(len(ids)) - (count.cumsum(0) - count).repeat_interleave(count)
    x, y = first[ids, 0] + place % across[ids], first[ids, 1] + place // across[ids]
    tile = y * tiles[0] + x
    return Bins(ids[tile.argsort(stable=True)], tile.bincount(minlength=int(tiles.prod())).tolist())


def composite(
    seen: Projected, opacities: Tensor, bins: Bins, background: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Color (H, W, 3), alpha (H, W) and depth (H, W), tile by tile; the definition is `render.reference`."""
    xx, xy, yy = seen.cov2d.unbind(-1)
    det = xx * yy - xy * xy
    conic = torch.stack([-0.5 * yy / det, xy / det, -0.5 * xx / det], -1)
    packed = torch.cat([seen.means2d, conic, opacities[:, None], seen.colors, seen.z[:, None]], -1)[bins.ids]
    y, x = torch.meshgrid(torch.arange(TILE) + 0.5, torch.arange(TILE) + 0.5, indexing="ij")
    pixels_x, pixels_y, tiles_x = x.reshape(1, -1), y.reshape(1, -1), -(-width // TILE)
    pieces = []
    for tile, records in enumerate(packed.split(bins.counts)):
        center_x, center_y, a, b, c, opacity = records[:, :6, None].unbind(1)
        dx = pixels_x + (tile % tiles_x * TILE) - center_x
        dy = pixels_y + (tile // tiles_x * TILE) - center_y
        # Processors are slow at numbers below the normal range, so they are kept out: far below what is drawn here,
        # and by logarithms in the product that nothing stops.
        power = (dx * (a * dx + b * dy) + c * dy * dy).clamp(min=MIN_POWER)
        alpha = (opacity * power.exp()).clamp(max=ALPHA_MAX)
        with torch.no_grad():
            visible = alpha >= ALPHA_MIN
            drawn = visible & ((-alpha * visible).log1p().cumsum(0) >= log(STOP_TRANSMITTANCE))
        alpha = alpha * drawn
        behind = torch.cat([torch.ones_like(pixels_x), torch.cumprod(1 - alpha, 0)])
        weights = alpha * behind[:-1]
        pieces.append(torch.cat([weights.T @ records[:, 6:], behind[-1:].T], -1))
    picture = torch.stack(pieces).view(-1, tiles_x, TILE, TILE, 5).transpose(1, 2)
    picture = picture.reshape(-1, tiles_x * TILE, 5)[:height, :width]
    transmittance = picture[..., 4]
    return picture[..., :3] + transmittance[..., None] * background, 1 - transmittance, picture[..., 3]


def rasterize(splats: Splats, camera: Camera, *, background: Tensor, depth_grad_to_means: bool = True) -> RenderOutput:
    """See `render.Rasterizer`."""
    seen = project(splats, camera)
    bins = bin_tiles(seen, splats.opacities, camera.width, camera.height)
    flat = seen if depth_grad_to_means else Projected(**(vars(seen) | {"z": seen.z.detach()}))
    color, alpha, depth = composite(flat, splats.opacities, bins, background, camera.width, camera.height)
    return RenderOutput(color, alpha, depth, seen.means2d, seen.radii)
