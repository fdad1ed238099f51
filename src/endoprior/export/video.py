"""A film of the frames of a split, from where they were taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..model.scene import Scene
from ..visualization.image_tools import to_u8
from ..visualization.video import write_video
from .moments import frame_indices
from .options import ExportOptions


def write(scene: Scene, out: Path, options: ExportOptions, progress: Callable[[int, int], None]) -> None:
    """H.264 mp4 at the sequence's frame rate."""
    chosen = frame_indices(len(scene.cameras), options.split)

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for k, i in enumerate(chosen):
            yield to_u8(scene.render(i / len(scene.cameras), scene.cameras[i]).color.numpy())
            progress(k + 1, len(chosen))

    write_video(out, pictures(), scene.frames_per_second)
