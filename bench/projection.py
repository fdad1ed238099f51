"""Projection and spherical harmonics of all Gaussians, forward and backward, beside `render.projection` in PyTorch.

`python bench/projection.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import scenes
import torch

from endoprior.render.autograd import Project
from endoprior.render.numba import KERNELS
from endoprior.render.projection import project

IMAGE = (640, 512)
"""It matters only for what is culled, which is next to nothing here."""


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Two rows for each number of Gaussians."""
    measured = []
    for num in common.nums(sizes):
        splats, camera = scenes.splats(common.Size(num, *IMAGE))
        inputs = [getattr(splats, name).requires_grad_() for name in ("means", "quats", "scales", "sh", "color_slopes")]
        cotangents = [torch.randn(shape) for shape in ((num, 2), (num, 3), (num,), (num, 3), (num, 2, 3))]
        ours = {
            "forward": lambda _, i=inputs, s=splats, c=camera: Project.apply(KERNELS, c, s.opacities, *i)[:5],
            "backward": lambda out, i=inputs, v=cotangents: torch.autograd.grad(out, i, v),
        }
        theirs = ours | {"forward": lambda _, s=splats, c=camera: list(vars(project(s, c)).values())[:5]}
        measured += common.rows("projection + SH", common.race(ours, theirs), num)
    return measured


if __name__ == "__main__":
    common.main(measure, __doc__)
