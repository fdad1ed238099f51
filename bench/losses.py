"""The supervised losses, forward and backward, beside their definitions in torch.

`python bench/losses.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import plain
import torch

from endoprior.training.loss_kernels import supervised_losses

WEIGHTS = (1.0, 1.0, 0.03)


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """One row for each picture: our forward pass finds the gradient as well, so the two belong together."""
    measured = []
    for width, height in common.pictures(sizes):
        generator = torch.Generator().manual_seed(0)
        color = torch.rand(height, width, 3, generator=generator, requires_grad=True)
        depth = (torch.rand(height, width, generator=generator) * 60 + 40).requires_grad_()
        target = torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)
        inverse = 1 / (torch.rand(height, width, generator=generator) * 60 + 40)
        mask = torch.rand(height, width, generator=generator) < 0.9

        def steps(terms, drawn=(color, depth), given=(target, inverse, mask, mask)) -> common.Steps:
            return {"": lambda _: torch.autograd.grad(terms(*drawn, *given, WEIGHTS).sum(), drawn)}

        result = common.race(steps(supervised_losses), steps(plain.supervised_losses))
        measured += common.rows("losses, both ways", result, None, (width, height))
    return measured


if __name__ == "__main__":
    common.main(measure, __doc__)
