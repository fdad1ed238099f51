"""An animated WebP file as a source. FFmpeg does not read these."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import accumulate, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL.Image import DecompressionBombError, Image
from PIL.Image import open as open_image

from ..core.checks import input_error
from ..data.reading import MOST_PIXELS
from .source_frame import SourceFrame
from .timeline import usual_rate


class Animation:
    """The images of a file and how long each is shown."""

    start, notes, was_damaged = 0.0, (), False

    def __init__(self, path: Path) -> None:
        """Read the durations; raises InputError if the file cannot be read."""
        self.path = path
        try:
            with open_image(path) as file:
                self.width, self.height = file.size
                too_large = self.width * self.height > MOST_PIXELS
                shown = [] if too_large else [_shown(file, index) for index in range(file.n_frames)]
        except (OSError, ValueError, SyntaxError, DecompressionBombError) as error:
            raise input_error(path, "a video", str(error).split("\n")[0], "Copy or export it again.") from None
        if too_large:
            got, hint = f"{self.width}x{self.height}", "Export it at a smaller size."
            raise input_error(path, f"images of at most {MOST_PIXELS // 1_000_000} Mpx", got, hint)
        self.num_frames, self.times = len(shown), [0.0, *accumulate(shown[:-1])]
        self.seconds = self.times[-1] + shown[-1]
        self.frames_per_second = usual_rate(self.times, [])

    def __iter__(self) -> Iterator[SourceFrame]:
        with open_image(self.path) as file:
            for index, time in enumerate(self.times):
                file.seek(index)
                yield SourceFrame(index, time, np.array(file.convert("RGB")))

    def glimpses(self, start: float, end: float, count: int) -> list[NDArray[np.uint8]]:
        """A few images (H, W, 3) from the whole file."""
        return [image.rgb_u8 for image in islice(self, 0, None, max(self.num_frames // count, 1))]


def _shown(file: Image, index: int) -> float:
    """How long an image is shown, s. Pillow knows it when the image is decoded."""
    file.seek(index)
    file.load()
    return float(file.info.get("duration", 0)) / 1000
