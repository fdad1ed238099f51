"""Render views to disk: color and depth of each view, side-by-side images, and a video."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.types import Frame
from ..model.photometric import behind_smoke
from ..model.scene import RenderedScene
from ..system.atomic import whole_file
from .camera_paths import View
from .image_tools import colorize, label, tile, to_u8, write_png
from .video import write_video

AT_A_TIME = 8
"""Number of views that a GPU renders in one call."""


def write_views(
    scene: RenderedScene,
    views: list[View],
    out: Path,
    video: Path,
    frames: Sequence[Frame] | None = None,
    *,
    smoke: bool = True,
) -> None:
    """Write each view to `out/rgb/*.png`, `out/depth/*.npy` (mm, float32) and `out/side_by_side/*.png`, and a video.

    Args:
        frames: the input frames, one per view; without them the side-by-side shows color and depth only.
        video: path of the mp4 of the side-by-side images.
        smoke: show the smoke of each time, where the scene has any.
    """
    span, at_a_time = depth_span(scene), 1 if scene.device.type == "cpu" else AT_A_TIME

    def pictures() -> Iterator[list[NDArray[np.uint8]]]:
        for start in range(0, len(views), at_a_time):
            times, cameras = zip(*views[start : start + at_a_time], strict=True)
            for k, rendered in enumerate(scene.render_many(list(times), list(cameras)), start):
                rendered = behind_smoke(rendered, scene.smoke_at(views[k][0])) if smoke else rendered
                color, depth = to_u8(rendered.color.cpu().numpy()), rendered.depth.cpu().numpy()
                write_png(out / "rgb" / f"{file_stem(k, frames)}.png", color)
                with whole_file(out / "depth" / f"{file_stem(k, frames)}.npy") as temporary:
                    np.save(temporary, depth)
                yield [label(color, "EndoPrior-GS"), label(colorize(depth, *span, depth > 0), "depth")]

    write_film(pictures(), out / "side_by_side", video, scene.frames_per_second, frames)


def write_film(
    pictures: Iterable[list[NDArray[np.uint8]]],
    out: Path,
    video: Path,
    frames_per_second: float,
    frames: Sequence[Frame] | None = None,
) -> None:
    """Write the pictures of each view beside each other as `out/*.png`, and all of them as a video.

    Args:
        pictures: (H, W, 3) images of one size for each view.
        frames: the input frames, one per view, which then stand at the left.
        video: path of the mp4.
    """

    def images() -> Iterator[NDArray[np.uint8]]:
        for k, parts in enumerate(pictures):
            beside = [label(frames[k].rgb_u8, "input"), *parts] if frames else parts
            image = tile(beside, len(beside))
            write_png(out / f"{file_stem(k, frames)}.png", image)
            yield image

    write_video(video, images(), frames_per_second)


def file_stem(k: int, frames: Sequence[Frame] | None) -> str:
    """Name of the files of view `k`: by its input frame, if there is one."""
    return f"{frames[k].index if frames else k:06d}"


def depth_span(scene: RenderedScene) -> tuple[float, float]:
    """Depth range of nearly all of the first frame, mm: one color scale for all images of a scene."""
    depth = scene.render(0.0).depth.cpu().numpy()
    covered = depth[depth > 0]
    low, high = np.percentile(covered, (2, 98)) if covered.size else (0.0, 1.0)
    return float(low), float(high)
