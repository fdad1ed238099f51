"""The scene as a file for another program, as the panel saves it."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from ..export import ExportOptions, export
from ..export.formats import Progress
from ..model.scene import Scene
from .panel import MESH, PLY, SLICER


@dataclass(frozen=True)
class SceneFile:
    """What one button saves."""

    format: str
    """Name of the export format."""
    stem: str
    """Of the file's name; that of one frame is followed by its index."""
    suffix: str
    of_one_frame: bool = False
    """Whether the file holds the shown frame; False: all of them."""


SCENE_FILES = {
    PLY: SceneFile("ply", "gaussians", ".ply", of_one_frame=True),
    SLICER: SceneFile("slicer", "tissue", ".mrb"),
    MESH: SceneFile("animation", "moving_mesh", ".glb"),
}
"""By the button's name."""


def scene_file(scene: Scene, button: str, frame: int, progress: Progress) -> tuple[str, bytes]:
    """Name and content of the file that a button of `SCENE_FILES` saves while `frame` is shown.

    Raises:
        InputError: there is nothing to write, such as a mesh of a scene without a surface.
    """
    wanted = SCENE_FILES[button]
    times = (scene.frame_time(frame),) if wanted.of_one_frame else ()
    name = wanted.stem + (f"_{frame:06d}" if wanted.of_one_frame else "") + wanted.suffix
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        # Exports compute on the CPU.
        export(scene.to("cpu", backend="numba"), file, ExportOptions(format=wanted.format, times=times), progress)
        return name, file.read_bytes()
