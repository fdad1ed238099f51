"""The whole scene, motion included, in the program's own open file; docs/format.md says how to read it."""

from __future__ import annotations

from pathlib import Path

from ..model.scene import Scene
from ..system.atomic import whole_folder
from .formats import Format, Progress
from .options import ExportOptions


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """One safetensors file, of equal bytes to the run's own if this version wrote that.

    For a scene of several windows, whose files stand side by side, a folder `out` with those of a run folder.
    """
    if len(scene.windows) == 1:
        scene.save(out)
    else:
        with whole_folder(out) as folder:
            scene.save(folder / "scene.safetensors")
    progress(1, 1)


FORMAT = Format(suffixes=(".safetensors",), options=(), write=write, holds="the whole scene, motion included")
