"""Sorting the Gaussians into tiles, near to far, beside the same in vectorized torch.

`python bench/binning.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import plain
import scenes

from endoprior.render.numba import KERNELS
from endoprior.render.projection import project


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """One row for each size."""
    measured = []
    for size in sizes:
        splats, camera = scenes.splats(size)
        inputs = (splats.means, splats.quats, splats.scales, splats.sh, splats.color_slopes)
        *projected, radii = KERNELS.project_forward(inputs, splats.opacities, camera)
        gaussians = (*projected, splats.opacities)
        seen, image = project(splats, camera), (size.width, size.height)
        ours = {"": lambda _, g=gaussians, r=radii, s=image: KERNELS.bin_tiles(g, r, s)}
        theirs = {"": lambda _, s=seen, o=splats.opacities, p=image: plain.bin_tiles(s, o, *p)}
        measured += common.rows("binning + sort", common.race(ours, theirs), size.num, image)
    return measured


if __name__ == "__main__":
    common.main(measure, __doc__)
