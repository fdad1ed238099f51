"""The whole scene, motion included, in the program's own open file; docs/format.md says how to read it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..model.scene import Scene
from .options import ExportOptions


def write(scene: Scene, out: Path, options: ExportOptions, progress: Callable[[int, int], None]) -> None:
    """One safetensors file, of equal bytes to the run's own if that was written by this version."""
    scene.save(out)
    progress(1, 1)
