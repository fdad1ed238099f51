"""A colored point cloud: the centers of the Gaussians that are opaque enough."""

from __future__ import annotations

import numpy as np
import torch

from ..core.checks import InputError
from ..model.scene import Scene
from ..render import sh
from .axes import turned_points
from .moments import Moment
from .options import ExportOptions
from .ply import ply_bytes, vertex_table


def files(scene: Scene, moment: Moment, options: ExportOptions) -> dict[str, bytes]:
    """A PLY file with x, y, z (mm) and red, green, blue (0..255), as seen from the moment's camera.

    Raises:
        InputError: no Gaussian is that opaque.
    """
    splats = moment.splats(scene, "opencv")
    chosen = splats.opacities >= options.min_opacity
    if not chosen.any():
        most = float(splats.opacities.max())
        raise InputError(
            f"--min-opacity: expected at most {most:.3f}, the largest there is; got {options.min_opacity}."
        )
    means = splats.means[chosen]
    towards = torch.nn.functional.normalize(means - torch.from_numpy(moment.camera(scene).center).to(means.dtype))
    colors = sh.colors(splats.sh[chosen], towards).numpy()
    rgb = np.rint(colors.clip(0, 1) * 255).astype(np.uint8)
    turned = turned_points(means.numpy(), options.frame)
    columns = {name: turned[:, i] for i, name in enumerate("xyz")}
    columns |= {name: rgb[:, i] for i, name in enumerate(("red", "green", "blue"))}
    return {".ply": ply_bytes(vertex_table(columns), options.frame)}
