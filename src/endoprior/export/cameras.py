"""The cameras of the frames in the `cameras.json` of 3D Gaussian splatting, which viewers of Gaussians read.

Source: the files that 3DGS writes (Kerbl et al. 2023). It is a format of its own, because SuperSplat takes a folder of
PLY files for a sequence only if nothing else is in it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core.types import Camera
from ..model.scene import Scene
from ..system.atomic import write_json
from .axes import points_in_axes
from .formats import TIME_STEP_OPTIONS, Axes, Format, Progress
from .options import ExportOptions
from .time_steps import selected_time_steps


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the .json file: one camera for each time step, in order."""
    steps = selected_time_steps(scene, options)
    write_json(out, [_entry(k, step.name, step.camera(scene), options.frame) for k, step in enumerate(steps)])
    progress(1, 1)


def _entry(number: int, name: str, camera: Camera, axes: Axes) -> dict[str, Any]:
    """Position (mm) and camera-to-world rotation of right, down, forward; px. 3DGS itself has no cx and cy."""
    return {
        "id": number,
        "img_name": name,
        "width": camera.width,
        "height": camera.height,
        "position": points_in_axes(camera.center, axes).tolist(),
        "rotation": points_in_axes(camera.world_to_camera[:3, :3], axes).T.tolist(),
        "fy": camera.fy,
        "fx": camera.fx,
        "cx": camera.cx,
        "cy": camera.cy,
    }


FORMAT = Format(suffixes=(".json",), options=TIME_STEP_OPTIONS, write=write, holds="cameras")
