"""The heads that read offsets from the trunk, forward and backward, beside the same in plain torch.

`python bench/heads.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import plain
import torch

from endoprior.core.config import DeformationConfig
from endoprior.model.deformation import HexPlaneField


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Two rows for each number of Gaussians."""
    generator = torch.Generator().manual_seed(0)
    field = HexPlaneField(torch.tensor([[1.0] * 3, [0.0] * 3]), DeformationConfig(), generator)
    other, measured = plain.Field(field), []
    for num in common.nums(sizes):
        trunk = torch.randn(num, field.cfg.hexplane.width, generator=generator, requires_grad=True)

        def steps(heads, network, trunk=trunk) -> common.Steps:
            inputs = [trunk, *(value for name, value in network.items() if not name.startswith("trunk"))]

            def backward(offsets: dict[str, torch.Tensor]) -> object:
                found = list(offsets.values())
                return torch.autograd.grad(found, inputs, [torch.ones_like(value) for value in found])

            return {"forward": lambda _: heads(trunk), "backward": backward}

        result = common.race(steps(field.heads, field.heads.parameters), steps(other.heads, other.network))
        measured += common.rows("MLP heads", result, num)
    return measured


if __name__ == "__main__":
    common.main(measure, __doc__)
