"""Video files, animations and image folders: a stream of images, each with its time.

Only a few images are in memory at a time. A source can be iterated any number of times.
"""

from __future__ import annotations

from pathlib import Path

from ..core.checks import input_error
from ..data.reading import kind_of
from ..data.video_files import is_animated_webp
from .animation import Animation
from .image_folder import ImageFolder
from .source_frame import SourceFrame
from .video import Video

Source = ImageFolder | Video | Animation

__all__ = ["Source", "SourceFrame", "open_source"]


def open_source(path: Path, frames_per_second: float = 25.0) -> Source:
    """Open a video file or a folder of images.

    Args:
        frames_per_second: rate of a folder of images.
    Returns:
        The source. `num_frames` and `seconds` are the announced number of images and duration, 0 if unknown; `times`
        holds when each image is shown, s since the first; `notes` what is particular about it, after an iteration.
    Raises:
        InputError: the file does not exist or cannot be read.
    """
    if (kind := kind_of(path)) == "a folder":
        return ImageFolder(path, frames_per_second)
    if kind != "a file":
        got = "no such file" if kind == "nothing" else kind
        raise input_error(path, "a video file or a folder of images", got, "Check the path.")
    return Animation(path) if is_animated_webp(path) else Video(path)
