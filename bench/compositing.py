"""Compositing, forward and backward, beside a plain torch compositor that works tile by tile under autograd.

`python bench/compositing.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import numpy as np
import plain
import scenes
import torch
from torch import Tensor

from endoprior.core.types import Camera, Splats
from endoprior.render.numba import KERNELS
from endoprior.render.projection import Projected, project

TORCH_MOST = 20_000
"""Gaussians; with more, autograd's memory alone takes torch from seconds to minutes."""


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Two rows for each size; backward counts the sum of the pairs per Gaussian."""
    measured = []
    for size in sizes:
        splats, camera = scenes.splats(size)
        cotangents = torch.from_numpy(np.random.default_rng(1).normal(size=(size.height, size.width, 5))).float()
        theirs = torch_steps(splats, camera, cotangents) if size.num <= TORCH_MOST else None
        image = (size.width, size.height)
        result = common.race(our_steps(splats, camera, cotangents), theirs)
        measured += common.rows("compositing", result, size.num, image)
    return measured


def our_steps(splats: Splats, camera: Camera, cotangents: Tensor) -> common.Steps:
    """The kernels on Gaussians that are already in the image and sorted into tiles."""
    inputs = (splats.means, splats.quats, splats.scales, splats.sh, splats.color_slopes)
    size = (camera.width, camera.height)
    *projected, radii = KERNELS.project_forward(inputs, splats.opacities, camera)
    tiles = KERNELS.bin_tiles((*projected, splats.opacities), radii, size)
    shape = (projected[1], projected[4], splats.opacities)
    given = tuple(part.contiguous() for part in by_image(cotangents))
    return {
        "forward": lambda _: KERNELS.composite_forward(tiles, torch.zeros(3), size),
        "backward": lambda out: KERNELS.composite_backward(tiles, out[3], *shape, out[:3], given),
    }


def by_image(cotangents: Tensor) -> tuple[Tensor, ...]:
    """(H, W, 5) cotangents in parts: of color, depth, alpha."""
    return cotangents[..., :3], cotangents[..., 3], cotangents[..., 4]


def torch_steps(splats: Splats, camera: Camera, cotangents: Tensor) -> common.Steps:
    """The same in plain torch, one color per Gaussian."""
    seen, opacities = project(splats, camera), splats.opacities.clone().requires_grad_()
    bins = plain.bin_tiles(seen, opacities, camera.width, camera.height)
    inputs = [t.clone().requires_grad_() for t in (seen.means2d, seen.cov2d, seen.z, seen.colors)]
    given, background = Projected(*inputs, seen.color_slopes2d, seen.radii), torch.zeros(3)
    v_color, v_depth, v_alpha = by_image(cotangents)
    return {
        "forward": lambda _: plain.composite(given, opacities, bins, background, camera.width, camera.height),
        "backward": lambda out: torch.autograd.grad(out, [*inputs, opacities], [v_color, v_alpha, v_depth]),
    }


if __name__ == "__main__":
    common.main(measure, __doc__)
