"""Cameras as `transforms.json`, which nerfstudio and its relatives read: camera to world, OpenGL axes."""

import json
from pathlib import Path

import numpy as np

from endoprior import Scene
from endoprior.export import ExportOptions
from endoprior.export.formats import ExportFormat, Progress
from endoprior.system.atomic import whole_file

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes (y up, z back) to OpenCV's."""


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write one file with the camera and the time of each frame."""
    frames = []
    for i, camera in enumerate(scene.cameras):
        lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        matrix = (np.linalg.inv(camera.world_to_camera) @ OPENGL).tolist()
        about = {"file_path": f"images/{i:06d}.png", "time": i / len(scene.cameras), "transform_matrix": matrix}
        frames.append(about | lens | {"w": camera.width, "h": camera.height})
        progress(i + 1, len(scene.cameras))
    with whole_file(out) as temporary:
        temporary.write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}, indent=1))


FORMAT = ExportFormat(suffixes=(".json",), options=(), write=write)
