"""A video of the frames of a split, rendered from the cameras of the sequence."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..model.scene import Scene
from ..visualization.image_tools import to_u8
from ..visualization.video import write_video
from .formats import Format, Progress
from .options import ExportOptions
from .time_steps import frame_indices


def write(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """H.264 mp4 at the sequence's frame rate."""
    indices = frame_indices(len(scene.cameras), options.split, scene.config.data)

    def images() -> Iterator[NDArray[np.uint8]]:
        for k, i in enumerate(indices):
            yield to_u8(scene.render(i / len(scene.cameras), scene.cameras[i]).color.numpy())
            progress(k + 1, len(indices))

    write_video(out, images(), scene.frames_per_second)


FORMAT = Format(suffixes=(".mp4",), options=("split",), write=write, holds="a video")
