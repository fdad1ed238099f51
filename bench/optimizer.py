"""Adam over the canonical Gaussians, beside torch.optim.Adam; `hexplane.py` and `basis.py` time the motion's.

`python bench/optimizer.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import plain
import scenes
import torch

from endoprior.core.presets import preset
from endoprior.training.optimizer import Optimizer


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """One row for each number of Gaussians: 59 numbers each, as under the preset `paper`."""
    cfg = preset("paper")
    measured = []
    for num in common.nums(sizes):
        splats, _ = scenes.splats(common.Size(num, 640, 512))
        mine, other = scenes.gaussians(splats, cfg), scenes.gaussians(splats, cfg)
        gradients = {name: torch.rand_like(value) for name, value in mine.tensors.items()}
        adams = Optimizer(mine, None, cfg, 10.0), plain.Adam(list(other.tensors.values()), cfg.optim.epsilon)

        def steps(adam, tensors, gradients=gradients) -> common.Steps:
            def give(_: object) -> None:
                for name, value in tensors.items():
                    value.grad = gradients[name]

            return {"_gradients": give, "": lambda _: adam.step(1)}

        result = common.race(steps(adams[0], mine.tensors), steps(adams[1], other.tensors))
        measured += common.rows("optimizer", result, num)
    return measured


if __name__ == "__main__":
    common.main(measure, __doc__)
