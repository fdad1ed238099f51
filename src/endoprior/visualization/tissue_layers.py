"""What is shown on the tissue: a grid that moves with it, and whether it was seen or guessed.

Three numbers for each Gaussian are blended as if they were its color, and decide what each pixel shows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .. import render
from ..core.geometry import pixel_centers, project
from ..core.types import Camera, Frame, Splats, frame_times, to_uint8
from ..model.carry import centers_then
from ..model.colors import with_fixed_color
from ..model.gaussians import with_colors
from ..model.scene import Scene
from ..model.surface import FramesOf, Support, project_visible, render_surface
from ..system.atomic import whole_file
from .image_tools import SOLID_ALPHA, label
from .rendered_views import TimedCamera, file_stem, write_side_by_side

SQUARES, STRIPES = 40, 80
"""Squares of the grid and stripes of the hatching along the width of the image: 16 px and 8 px of 640."""
LINE, LINE_COLOR, LINE_SHARE = 0.2, np.array((0.3, 1.0, 1.0)), 0.5
"""Width of a line, in sides of a square; its light blue, which tissue does not have; share of that in its pixels."""
FARTHEST = 2
"""Largest motion in the image that is carried, in widths of the image."""
HATCHING, TINT = np.array((1.0, 1.0, 1.0)), np.array((0.2, 0.5, 1.0))
"""Colors of stripes, and of tissue from another time."""
DOTS = np.array((0.0, 0.0, 0.0))  # color of dots where depth is a guess
HATCHING_SHARE, TINT_SHARE = 0.6, 0.5
"""Their largest shares in a pixel."""
TINTED_FROM_S, FULL_TINT_S = 0.1, 2.0
"""Tissue last seen so long before or after gets some tint, and all of it."""


def _rendered(scene: Scene, splats: Splats, camera: Camera, numbers: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """(H, W, 3) color, (H, W, 3) blended numbers, (H, W) alpha of one view; `numbers` is (N, 3) in [0, 1]."""
    rasterize, black = render.load(scene.backend), splats.means.new_zeros(3)
    color = rasterize(splats, camera, background=black).view.color
    out = rasterize(with_colors(splats, numbers), camera, background=black)
    return color.cpu().numpy(), out.color.cpu().numpy(), out.alpha.cpu().numpy()


class PaintedTissue:
    """A scene with a grid on the tissue that the camera sees at one time; it shows how the model moves.

    Each Gaussian has its mean color over all frames: only motion can change the picture. What is hidden or outside of
    the image at that time is not painted. The grid is not a color of the Gaussians, whose size would blur it: what is
    blended is how far each has moved in the image, and each pixel looks up the grid where it came from.
    """

    def __init__(self, scene: Scene, time: float = 0.0) -> None:
        """Paint what the camera sees at `time` in [0, 1]."""
        camera = scene.camera_at(time)
        self._scene = with_fixed_color(scene, frame_times(len(scene.cameras)))
        self._painted_at, self._surface = time, render_surface(scene, time, camera)
        self._square = camera.width / SQUARES

    @torch.no_grad()
    def render(self, time: float, camera: Camera) -> NDArray[np.float32]:
        """(H, W, 3) color in [0, 1] at `time` in [0, 1]."""
        splats = self._scene.at(time)
        # The way back to where a Gaussian was when it was painted, and whether it was.
        before, painted = project_visible(centers_then(self._scene, time, self._painted_at), self._surface)
        pixels, _ = project(splats.means.cpu().numpy().astype(np.float64), camera)
        span = 2 * FARTHEST * camera.width
        numbers = np.column_stack([np.clip((before - pixels) / span + 0.5, 0, 1), painted])
        color, blended, alpha = _rendered(self._scene, splats, camera, numbers)
        back = (blended[..., :2] / np.maximum(alpha[..., None], 1e-6) - 0.5) * span
        lines = _grid(pixel_centers(camera.width, camera.height) + back, self._square)
        share = LINE_SHARE * blended[..., 2:] * lines[..., None]
        return ((1 - share) * color + share * LINE_COLOR).astype(np.float32)


def _grid(pixels: NDArray, side: float) -> NDArray[np.float64]:
    """(H, W) how much a line of a grid of `side` px covers (H, W, 2) positions, in [0, 1]; its edges are 1 px wide."""
    distance = np.abs((pixels / side + 0.5) % 1 - 0.5).min(-1) * side
    return np.clip(0.5 + LINE / 2 * side - distance, 0, 1)


class SupportPicture(NamedTuple):
    """What one camera sees at one time, and where it is from."""

    color: NDArray[np.float32]
    """(H, W, 3) in [0, 1]: the tissue, hatched where no frame saw it, tinted where it is from another time, and dotted
    where it was seen, but its depth not measured."""
    num_frames: NDArray[np.float32]
    """(H, W) training frames that saw this tissue; NaN where there is none."""
    gap_seconds: NDArray[np.float32]
    """(H, W) time to the nearest of them; infinite where no frame saw it, NaN where there is no tissue."""
    legend: str
    """What the marks mean, in one short line."""


class SupportMap:
    """Renders a scene with what its training frames saw of it."""

    def __init__(self, scene: Scene, frames_of: FramesOf) -> None:
        self._scene, self._support = scene, Support(scene, frames_of)
        self._longest = len(scene.cameras) / scene.frames_per_second

    @torch.no_grad()
    def render(self, time: float, camera: Camera) -> SupportPicture:
        """The picture at `time` in [0, 1]."""
        frames, gap = self._support.num_frames(time), self._support.gap(time)
        guessed, most, longest = ~np.isfinite(gap), max(frames.max(initial=0), 1), self._longest
        numbers = np.column_stack([frames / most, np.where(guessed, 0, gap / longest), guessed])
        splats = self._scene.at(time)
        color, blended, alpha = _rendered(self._scene, splats, camera, numbers)
        solid = alpha > SOLID_ALPHA
        share, gap, guess = np.moveaxis(blended / np.where(solid, alpha, 1)[..., None], -1, 0)
        seconds = gap / np.maximum(1 - guess, 1e-6) * longest
        is_guess = guess > 0.5
        dotted = np.zeros_like(solid)
        if (by_depth := self._support.depth_is_guess(time)).any():
            shares = _rendered(self._scene, splats, camera, np.repeat(by_depth[:, None], 3, 1))[1][..., 0]
            dotted = solid & ~is_guess & (shares > 0.5 * alpha)
        return SupportPicture(
            _marked(color, solid & is_guess, np.where(solid & ~is_guess, seconds, 0), dotted),
            np.where(solid, np.where(is_guess, 0, share * most), np.nan).astype(np.float32),
            np.where(solid, np.where(is_guess, np.inf, seconds), np.nan).astype(np.float32),
            f"hatched: guessed; {'dotted: depth guessed' if dotted.any() else 'blue: from another time'}",
        )


def _marked(
    color: NDArray, guessed: NDArray[np.bool_], seconds: NDArray, dotted: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """(H, W, 3) `color` with hatching where `guessed`, a tint by `seconds`, and dots where `dotted`, (H, W) each."""
    height, width = guessed.shape
    tint = TINT_SHARE * np.clip((seconds - TINTED_FROM_S) / (FULL_TINT_S - TINTED_FROM_S), 0, 1)[..., None]
    color = (1 - tint) * color + tint * TINT
    stripe = (pixel_centers(width, height).sum(-1) * STRIPES / width) % 2 < 0.7
    hatching = HATCHING_SHARE * (guessed & stripe)[..., None]
    dots = HATCHING_SHARE * (dotted & ((pixel_centers(width, height) * STRIPES / width) % 2 < 0.7).all(-1))[..., None]
    color = (1 - hatching) * color + hatching * HATCHING
    return ((1 - dots) * color + dots * DOTS).astype(np.float32)


def write_texture_video(
    scene: Scene, views: list[TimedCamera], out: Path, video: Path, frames: Sequence[Frame] | None = None
) -> None:
    """Write a grid, painted on the first frame, as it is carried to each view; see `write_side_by_side`."""
    painted = PaintedTissue(scene)
    pictures = ([label(to_uint8(painted.render(*view)), "carried grid")] for view in views)
    write_side_by_side(pictures, out, video, scene.frames_per_second, frames)


def write_support_video(
    support: SupportMap,
    views: list[TimedCamera],
    out: Path,
    video: Path,
    frames_per_second: float,
    frames: Sequence[Frame] | None = None,
) -> None:
    """Write each view, and what stands behind it as `out/*.npy`; see `write_side_by_side`.

    The NPY is (H, W, 2) float32: `SupportPicture.num_frames` and `gap_seconds`.
    """

    def pictures() -> Iterator[list[NDArray[np.uint8]]]:
        for k, view in enumerate(views):
            shown = support.render(*view)
            with whole_file(out / f"{file_stem(k, frames)}.npy") as temporary:
                np.save(temporary, np.stack([shown.num_frames, shown.gap_seconds], -1))
            yield [label(to_uint8(shown.color), shown.legend)]

    write_side_by_side(pictures(), out, video, frames_per_second, frames)
