"""A grid painted on the tissue of one frame and carried by the Gaussians: it shows how the model moves.

Colors are fixed: only motion can change the picture. The grid is not a color of the Gaussians, whose size would blur
it: what is blended is how far each has moved in the image, and each pixel looks up the grid where it came from.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from .. import render
from ..core.geometry import pixel_centers, project
from ..core.types import Camera, Frame
from ..model.carry import centers_then
from ..model.colors import with_fixed_color
from ..model.gaussians import with_colors
from ..model.scene import Scene
from ..model.surface import project_visible, render_surface
from .camera_paths import View
from .image_tools import label, tile, to_u8, write_png
from .video import write_video

SQUARES = 40
"""Squares of the grid along the width of the image: 16 px of 640."""
LINE = 0.2
"""Width of a line, in sides of a square."""
COLOR = np.array((0.3, 1.0, 1.0))
"""Color of the lines: light blue, which tissue does not have."""
SHARE = 0.5
"""Share of that color where a line is; the rest is that of the tissue."""
FARTHEST = 2
"""Largest motion in the image that is carried, in widths of the image."""


class PaintedTissue:
    """A scene with a grid on the tissue that the camera sees at one time.

    Each Gaussian has its mean color over all frames. What is hidden or outside of the image at that time is not
    painted.
    """

    def __init__(self, scene: Scene, time: float = 0.0) -> None:
        """Paint what the camera sees at `time` in [0, 1]."""
        num, camera = len(scene.cameras), scene.camera_at(time)
        self._scene = with_fixed_color(scene, [i / num for i in range(num)])
        self._rasterize = render.load(scene.backend)
        self._painted_at, self._surface = time, render_surface(scene, time, camera)
        self._square = camera.width / SQUARES

    @torch.no_grad()
    def render(self, time: float, camera: Camera) -> NDArray[np.float32]:
        """(H, W, 3) color in [0, 1] at `time` in [0, 1]."""
        splats = self._scene.at(time)
        black = splats.means.new_zeros(3)
        color = self._rasterize(splats, camera, background=black).view.color.cpu().numpy()

        # Three numbers for each Gaussian, blended as if they were its color, in [0, 1]: the way back to where it was
        # when it was painted, and whether it was.
        before, painted = project_visible(centers_then(self._scene, time, self._painted_at), self._surface)
        pixels, _ = project(splats.means.cpu().numpy().astype(np.float64), camera)
        span = 2 * FARTHEST * camera.width
        back = np.clip((before - pixels) / span + 0.5, 0, 1)
        numbers = np.column_stack([back, painted])
        carried = self._rasterize(with_colors(splats, numbers), camera, background=black)
        blended, alpha = carried.color.cpu().numpy(), carried.alpha.cpu().numpy()[..., None]
        back = (blended[..., :2] / np.maximum(alpha, 1e-6) - 0.5) * span
        lines = _grid(pixel_centers(camera.width, camera.height) + back, self._square)
        share = SHARE * blended[..., 2:] * lines[..., None]
        return ((1 - share) * color + share * COLOR).astype(np.float32)


def _grid(pixels: NDArray, side: float) -> NDArray[np.float64]:
    """(H, W) how much a line of a grid of `side` px covers (H, W, 2) positions, in [0, 1]; its edges are 1 px wide."""
    distance = np.abs((pixels / side + 0.5) % 1 - 0.5).min(-1) * side
    return np.clip(0.5 + LINE / 2 * side - distance, 0, 1)


def write_texture_film(
    scene: Scene, views: list[View], out: Path, video: Path, frames: list[Frame] | None = None
) -> None:
    """Write a grid, painted on the first frame, as it is carried to each view: `out/*.png`, and a video.

    Args:
        frames: the input frames, one per view, which then stand at the left.
        video: path of the mp4.
    """
    painted = PaintedTissue(scene)

    def images() -> Iterator[NDArray[np.uint8]]:
        for k, view in enumerate(views):
            parts = [label(frames[k].rgb_u8, "input")] if frames else []
            parts.append(label(to_u8(painted.render(*view)), "carried grid"))
            beside = tile(parts, len(parts))
            write_png(out / f"{frames[k].index if frames else k:06d}.png", beside)
            yield beside

    write_video(video, images(), scene.frames_per_second)
