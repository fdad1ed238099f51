"""HexPlane with the linear trunk on its features, both ways, and the planes' Adam step, beside plain torch.

`python bench/hexplane.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import plain
import scenes
import torch

from endoprior.core.config import DeformationConfig
from endoprior.model.deformation import HexPlaneField
from endoprior.training.plane_adam import PlaneAdam

MOMENT, LEARNING_RATE = 0.4, 1e-3
EARLIER_MOMENTS = (0.05, 0.2, 0.6, 0.85)
"""Steps at these come first: training has touched cells at other times too, and Adam steps them all."""


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Three rows for each number of Gaussians: forward, backward, update."""
    measured = []
    for num in common.nums(sizes):
        points, generator = scenes.sheet(num), torch.Generator().manual_seed(0)
        field = HexPlaneField.from_points(points, DeformationConfig(), generator)
        box = field.box.detach()
        unit = ((points - box[0]) / (box[1] - box[0])).requires_grad_()
        cotangent = torch.randn(num, field.cfg.hexplane.width, generator=generator)
        result = common.race(ours(field, unit, cotangent), theirs(field, unit, cotangent))
        measured += common.rows("hexplane + trunk", result, num)
    return measured


def ours(field: HexPlaneField, unit: torch.Tensor, cotangent: torch.Tensor) -> common.Steps:
    """The gradient of the planes goes to `grid.grads`, which the update clears."""
    grid, trunk = field.grid, field.heads.trunk
    adam = PlaneAdam(grid)
    for moment in EARLIER_MOMENTS:
        torch.autograd.grad(grid.linear(unit, (moment,), *trunk), [unit, *trunk], [cotangent])
        adam.step(LEARNING_RATE)
    return {
        "forward": lambda _: grid.linear(unit, (MOMENT,), *trunk),
        "backward": lambda out: torch.autograd.grad(out, [unit, *trunk], [cotangent]),
        "update": lambda _: adam.step(LEARNING_RATE),
    }


def theirs(of: HexPlaneField, unit: torch.Tensor, cotangent: torch.Tensor) -> common.Steps:
    """The same on copies of the planes."""
    field = plain.Field(of)
    planes, trunk = field.grid.parameters(), [field.network["trunk.weight"], field.network["trunk.bias"]]
    adam = plain.Adam(planes, epsilon=1e-15)
    return {
        "forward": lambda _: field.trunk(field.grid.sample(unit, MOMENT)),
        "backward": lambda out: out.backward(cotangent, inputs=[unit, *trunk, *planes]),
        "update": lambda _: adam.step(),
    }


if __name__ == "__main__":
    common.main(measure, __doc__)
