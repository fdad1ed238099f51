"""A checkerboard painted on the tissue of the first frame and carried by the Gaussians: it shows how the model moves.

The painted scene has no color over time, so that only motion can move the pattern.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.types import Frame
from ..model.fixed_color import with_fixed_color
from ..model.gaussians import SH_C0, Gaussians
from ..model.scene import Scene
from ..model.surface import project_visible, render_surface
from .camera_paths import View
from .image_tools import label, tile, to_u8, write_png
from .video import write_video

SQUARES = 40
"""Squares of the checkerboard along the width of the image: 16 px of 640."""
COLORS = np.array([(0.0, 0.1, 0.3), (0.3, 1.0, 1.0)])
"""Colors of the squares: dark and light blue, which tissue does not have."""
SHARE = 0.5
"""Share of the pattern in the color of the painted tissue."""


def paint_texture(scene: Scene, time: float = 0.0) -> Scene:
    """`scene` with fixed colors and a checkerboard on the tissue that the camera sees at `time`, in [0, 1].

    Each Gaussian has its mean color over all frames. Those that the camera sees at `time` take half of their color
    from the square that their center projects to; the others are not painted.
    """
    num = len(scene.cameras)
    fixed = with_fixed_color(scene, [i / num for i in range(num)])
    camera = scene.camera_at(time)
    centers = scene.at(time).means.cpu().numpy()
    pixels, visible = project_visible(centers, render_surface(scene, time, camera))
    chosen = torch.from_numpy(np.flatnonzero(visible)).to(scene.device)
    pattern = torch.from_numpy((_checkerboard(pixels[visible], camera.width) - 0.5) / SH_C0).to(scene.device)
    tensors = {name: value.detach() for name, value in fixed.gaussians.tensors.items()}
    colors, rest = tensors["sh_dc"].clone(), tensors["sh_rest"].clone()
    colors[chosen] = (1 - SHARE) * colors[chosen] + SHARE * pattern[:, None].to(colors)
    rest[chosen] *= 1 - SHARE
    return replace(fixed, gaussians=Gaussians(tensors | {"sh_dc": colors, "sh_rest": rest}))


def _checkerboard(pixels: NDArray, width: int) -> NDArray[np.float64]:
    """(P, 3) color in [0, 1] of the square at each of (P, 2) pixels."""
    squares = np.floor(pixels * (SQUARES / width)).astype(np.intp)
    return COLORS[squares.sum(1) % 2]


def write_texture_film(
    scene: Scene, views: list[View], out: Path, video: Path, frames: list[Frame] | None = None
) -> None:
    """Write the scene of `paint_texture` as seen in each view, to `out/*.png`, and a video of these images.

    Args:
        frames: the input frames, one per view, which then stand at the left.
        video: path of the mp4.
    """
    painted = paint_texture(scene)

    def images() -> Iterator[NDArray[np.uint8]]:
        for k, (time, camera) in enumerate(views):
            color = to_u8(painted.render(time, camera).color.cpu().numpy())
            parts = [label(frames[k].rgb_u8, "input")] if frames else []
            parts.append(label(color, "pattern of the first frame, carried"))
            beside = tile(parts, len(parts))
            write_png(out / f"{frames[k].index if frames else k:06d}.png", beside)
            yield beside

    write_video(video, images(), scene.frames_per_second)
