"""The yardstick: every stage in plain torch, differentiated by autograd, written as one would without kernels.

Same results as the package up to rounding (`tests/test_bench.py`). Shared letters: `N` Gaussians, `P` pairs of a tile
and a Gaussian in it, `L` tiles.
"""

from __future__ import annotations

from math import log
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample, linear, relu

from endoprior.core.config import DeformationConfig
from endoprior.core.types import Camera, RenderOutput, Splats
from endoprior.model.basis import basis_weights, motion_layout
from endoprior.model.deformation import HexPlaneField, Offsets
from endoprior.model.hexplane import PLANE_NAMES, PlaneGrid
from endoprior.render.constants import ALPHA_MAX, ALPHA_MIN, STOP_TRANSMITTANCE
from endoprior.render.projection import Projected, project
from endoprior.training.losses import supervised as supervised_losses  # noqa: F401
from endoprior.training.temporal import SUM_EPS
from endoprior.training.temporal import local_motion_definition as local_motion_loss  # noqa: F401

TILE = 16
"""Side of a tile, px."""
LEAST_POWER = -20.0
"""Powers below this change nothing: alpha is under ALPHA_MIN long before."""
NEIGHBOR_CHUNK = 1024
"""Points whose distances to all others are held at a time."""


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
        power = (dx * (a * dx + b * dy) + c * dy * dy).clamp(min=LEAST_POWER)
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


class Grid:
    """A copy of the planes of a `PlaneGrid`, sampled by `grid_sample` and trained by autograd."""

    def __init__(self, grid: PlaneGrid) -> None:
        self.full_time = grid.time_map == "full"
        self.planes = [
            [grid.plane(s, name).permute(2, 0, 1)[None].contiguous().requires_grad_(True) for name in PLANE_NAMES]
            for s in range(grid.num_scales)
        ]
        """(1, C, rows, columns) each."""

    def parameters(self) -> list[Tensor]:
        """Every plane."""
        return [plane for scale in self.planes for plane in scale]

    def sample(self, unit: Tensor, time: float) -> Tensor:
        """See `PlaneGrid.sample`."""
        moment = 2 * time - 1 if self.full_time else time
        where = torch.cat([unit * 2 - 1, torch.full_like(unit[:, :1], moment)], -1)
        features = []
        for scale in self.planes:
            product = 1.0
            for name, plane in zip(PLANE_NAMES, scale, strict=True):
                axes = where[:, ["xyzt".index(axis) for axis in name]][None, None]
                sample = grid_sample(plane, axes, mode="bilinear", padding_mode="border", align_corners=True)
                product = product * sample[0, :, 0]
            features.append(product.T)
        return torch.cat(features, -1)


class Field:
    """A copy of a HexPlane field, all of it trained by autograd."""

    def __init__(self, field: HexPlaneField) -> None:
        self.grid, self.outputs = Grid(field.grid), field.heads.outputs
        self.box = field.box.detach().clone().requires_grad_()
        self.network = {name: value.detach().clone().requires_grad_() for name, value in field.heads.parameters.items()}

    def parameters(self) -> list[Tensor]:
        """Every trained tensor."""
        return [*self.grid.parameters(), self.box, *self.network.values()]

    def offsets(self, means: Tensor, time: float) -> Offsets:
        """See `HexPlaneField.offsets`."""
        unit = (means - self.box[0]) / (self.box[1] - self.box[0])
        found = self.heads(self.trunk(self.grid.sample(unit, time)))
        return Offsets(**{name: value[:, 0] if name == "opacity_logits" else value for name, value in found.items()})

    def offsets_and_displacement(self, means: Tensor, time: float, other: float) -> tuple[Offsets, Tensor]:
        """See `HexPlaneField.offsets_and_displacement`."""
        return self.offsets(means, time), self.offsets(means, other).means

    def trunk(self, features: Tensor) -> Tensor:
        """The linear layer under all heads."""
        return self._layer("trunk", features)

    def heads(self, trunk: Tensor) -> dict[str, Tensor]:
        """Offsets by name."""
        shared = relu(trunk)
        return {
            name: self._layer(f"{name}.output", relu(self._layer(f"{name}.hidden", shared))) for name in self.outputs
        }

    def _layer(self, name: str, inputs: Tensor) -> Tensor:
        return linear(inputs, self.network[f"{name}.weight"], self.network[f"{name}.bias"])


def basis_offsets(motion: Tensor, time: float, cfg: DeformationConfig, sink: object = None) -> Offsets:
    """See `model.basis.basis_offsets`; the gradient goes to `motion`, `sink` stays empty."""
    weights = torch.from_numpy(basis_weights(time, cfg.basis)).to(motion.dtype)
    total = torch.einsum("nbc,b->nc", motion, weights)
    found = {name: total[:, part] for name, part in motion_layout(cfg).items()}
    return Offsets(**{name: value[:, 0] if name == "opacity_logits" else value for name, value in found.items()})


def neighbors(points: NDArray, k: int) -> tuple[NDArray[np.intp], NDArray]:
    """See `temporal.neighbors`: all distances, a chunk of points at a time."""
    where = torch.from_numpy(points)
    found = []
    for start in range(0, len(where), NEIGHBOR_CHUNK):
        distances = torch.cdist(where[start : start + NEIGHBOR_CHUNK], where)
        distances[torch.arange(len(distances)), torch.arange(len(distances)) + start] = torch.inf
        found.append(distances.topk(k, largest=False))
    return torch.cat([f.indices for f in found]).numpy(), torch.cat([f.values for f in found]).numpy()


def affinity(distances: NDArray, indices: NDArray, weights: NDArray) -> NDArray:
    """See `temporal.affinity`, Eq. (10)."""
    near, index, weight = torch.from_numpy(distances), torch.from_numpy(indices), torch.from_numpy(weights)
    sigma = near.median().clamp(min=1e-8)
    pairs = (-(near**2) / (2 * sigma**2)).exp() * weight[:, None] * weight[index]
    return pairs.clamp(min=SUM_EPS).numpy()


class Adam:
    """torch.optim.Adam in the place of `optim.Optimizer`: the same parameters, one constant rate."""

    def __init__(self, parameters: list[Tensor], epsilon: float) -> None:
        self.adam = torch.optim.Adam(parameters, lr=1e-4, eps=epsilon)

    def count_unusable(self) -> dict[str, int]:
        """Plain torch looks at no gradient before it applies it."""
        return {}

    def step(self, iteration: int = 0, frozen: Tensor | None = None) -> None:
        """Apply the gradients and clear them."""
        self.adam.step()
        self.adam.zero_grad()
