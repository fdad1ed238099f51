"""Sorting the Gaussians into tiles, near to far, beside the same in vectorized torch.

`python bench/binning.py [--quick] [--json FILE]`
"""

from __future__ import annotations

import common
import plain
import scenes

from endoprior.render import tiles
from endoprior.render.cpu import Project
from endoprior.render.projection import project


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """One row for each size."""
    measured = []
    for size in sizes:
        splats, camera = scenes.splats(size)
        projected = Project.apply(splats.means, splats.quats, splats.scales, splats.sh, splats.opacities, camera)
        means2d, row_forms, z, colors, radii = (t.numpy() for t in projected)
        arrays = (means2d, row_forms, z, colors, splats.opacities.numpy(), radii)
        seen, picture = project(splats, camera), (size.width, size.height)
        ours = {"": lambda _, a=arrays, p=picture: tiles.build(*a, *p)}
        theirs = {"": lambda _, s=seen, o=splats.opacities, p=picture: plain.bin_tiles(s, o, *p)}
        measured += common.rows("binning + sort", common.race(ours, theirs), size.num, picture)
    return measured


if __name__ == "__main__":
    common.main(measure, __doc__)
