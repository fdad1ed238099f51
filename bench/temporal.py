"""The temporal term, Eqs. (10) and (11): neighbors and affinities, then loss and gradient, beside plain torch.

`python bench/temporal.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import numpy as np
import plain
import scenes
import torch

from endoprior.core.presets import preset
from endoprior.training import temporal

TORCH_MOST = 20_000
"""Points; distances of all pairs grow with their square."""


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Two rows for each number of points: as many as the preset `default` draws, then all Gaussians."""
    cfg = preset("default").temporal
    measured = []
    for num in sorted({cfg.max_points, *common.nums(sizes)}):
        before = scenes.sheet(num)
        generator = torch.Generator().manual_seed(1)
        now = (before + 0.1 * torch.randn(num, 3, generator=generator)).requires_grad_()
        weights = np.ones(num)

        def steps(module, before=before, now=now, weights=weights) -> common.Steps:
            def pairs(_: object) -> tuple[np.ndarray, np.ndarray]:
                indices, distances = module.neighbors(before.numpy(), cfg.num_neighbors)
                return indices, module.affinity(distances, indices, weights)

            def gradient(found: tuple[np.ndarray, np.ndarray]) -> object:
                return torch.autograd.grad(sum(module.local_motion_loss(now, before, *found, cfg)), now)

            return {"neighbors + affinity": pairs, "loss + gradient": gradient}

        result = common.race(steps(temporal), steps(plain) if num <= TORCH_MOST else None)
        measured += common.rows("temporal", result, num)
    return measured


if __name__ == "__main__":
    common.main(measure, __doc__)
