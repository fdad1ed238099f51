"""Drawn views on disk: color and depth per view, side-by-side pictures, and a video."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.types import Frame, RenderOutput
from ..model.scene import Scene
from ..system.atomic import whole_file
from .camera_paths import View
from .image_tools import colorize, label, tile, to_u8, write_png
from .video import write_video

AT_A_TIME = 8
"""Views that a GPU draws in one call."""


def write_views(
    scene: Scene,
    views: list[View],
    out: Path,
    video: Path,
    frames: list[Frame] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Draw each view into `out/rgb/*.png`, `out/depth/*.npy` (mm, float32) and `out/side_by_side/*.png`, and a film.

    Args:
        frames: the originals, one per view; without them the side-by-side shows color and depth only.
        video: path of the mp4 of the side-by-side pictures.
    """
    span = depth_span(scene)

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for k, drawn in enumerate(_drawn(scene, views)):
            color, depth = to_u8(drawn.color.cpu().numpy()), drawn.depth.cpu().numpy()
            name = f"{frames[k].index if frames else k:06d}"
            write_png(out / "rgb" / f"{name}.png", color)
            with whole_file(out / "depth" / f"{name}.npy") as temporary:
                np.save(temporary, depth)
            parts = [label(frames[k].rgb_u8, "input")] if frames else []
            parts += [label(color, "EndoPrior-GS"), label(colorize(depth, *span, depth > 0), "depth")]
            beside = tile(parts, len(parts))
            write_png(out / "side_by_side" / f"{name}.png", beside)
            progress(k + 1, len(views))
            yield beside

    write_video(video, pictures(), scene.frames_per_second)


def _drawn(scene: Scene, views: list[View]) -> Iterator[RenderOutput]:
    """Each view, several at a time where that is cheaper."""
    at_a_time = 1 if scene.device.type == "cpu" else AT_A_TIME
    for start in range(0, len(views), at_a_time):
        times, cameras = zip(*views[start : start + at_a_time], strict=True)
        yield from scene.render_many(list(times), list(cameras))


def depth_span(scene: Scene) -> tuple[float, float]:
    """Depths, mm, between which nearly all of the first moment lies: one color scale for all pictures of a scene."""
    depth = scene.render(0.0).depth.cpu().numpy()
    drawn = depth[depth > 0]
    low, high = np.percentile(drawn, (2, 98)) if drawn.size else (0.0, 1.0)
    return float(low), float(high)
