"""Files that the viewer saves: the scene for another program, a video; and a folder of this machine that keeps them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..export import ExportOptions, export
from ..export.formats import Progress
from ..model.scene import Scene
from ..system.atomic import whole_file
from ..visualization.video import write_video
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
        export(scene, file, ExportOptions(format=wanted.format, times=times), progress)
        return name, file.read_bytes()


def video_file(pictures: Iterable[NDArray[np.uint8]], frames_per_second: float) -> bytes:
    """Content of an H.264 video of images (H, W, 3) of one size."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "video.mp4"
        write_video(file, pictures, frames_per_second)
        return file.read_bytes()


def keep(folder: Path, name: str, content: bytes) -> Path:
    """Write a file with the first free name `stem_N.suffix` in `folder`, and return its path; never overwrite a file.

    Args:
        name: a plain file name.
    Raises:
        ValueError: `name` contains a folder, or has no suffix.
        InputError: `folder` is a link: in an untrusted run it could point anywhere.
    """
    if folder.is_symlink():
        raise input_error(folder, "a folder", "a link to one", "Remove the link.")
    stem, suffix = Path(name).stem, Path(name).suffix
    if Path(name).name != name or not suffix:
        raise ValueError(f"name must be a plain file name with a suffix, got {name!r}")
    numbered = (folder / f"{stem}_{number}{suffix}" for number in count(1))
    file = next(path for path in numbered if not path.exists())
    with whole_file(file) as temporary:
        temporary.write_bytes(content)
    return file
