"""A colored point cloud: the centers of the Gaussians that are opaque enough."""

from __future__ import annotations

import numpy as np
import torch

from ..core.checks import input_error
from ..core.geometry import length_unit
from ..model.scene import Scene
from ..render import sh
from .axes import points_in_axes
from .formats import TIME_STEP_OPTIONS, Format
from .options import ExportOptions
from .ply import ply_bytes, vertex_table
from .time_steps import TimeStep


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """A PLY file with x, y, z (mm) and red, green, blue (0..255), as seen from the frame's camera.

    Raises:
        InputError: no Gaussian is that opaque.
    """
    splats = step.splats(scene, "opencv")
    opaque = splats.opacities >= options.min_opacity
    if not opaque.any():
        most = float(splats.opacities.max())
        want = f"at most {most:.3f}, the largest opacity"
        raise input_error("--min-opacity", want, f"{options.min_opacity}", "lower it.")
    means = splats.means[opaque]
    towards = torch.nn.functional.normalize(means - torch.from_numpy(step.camera(scene).center).to(means.dtype))
    colors = sh.colors(splats.sh[opaque], towards).numpy()
    rgb = np.rint(colors.clip(0, 1) * 255).astype(np.uint8)
    positions = points_in_axes(means.numpy(), options.frame)
    columns = {name: positions[:, i] for i, name in enumerate("xyz")}
    columns |= {name: rgb[:, i] for i, name in enumerate(("red", "green", "blue"))}
    unit = length_unit(scene.lengths_are_relative)
    return {".ply": ply_bytes(vertex_table(columns), options.frame, unit)}


FORMAT = Format(
    suffixes=(".ply",), options=(*TIME_STEP_OPTIONS, "canonical", "min_opacity"), files=files, holds="colored points"
)
