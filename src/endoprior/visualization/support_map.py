"""Seen or guessed: pictures in which tissue that no frame saw is hatched, and tissue from another time is tinted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from .. import render
from ..core.geometry import pixel_centers
from ..core.types import Camera, Frame
from ..model.gaussians import with_colors
from ..model.scene import Scene
from ..model.surface import FramesOf, Support
from ..system.atomic import whole_file
from .camera_paths import View
from .image_tools import SOLID_ALPHA, label, tile, to_u8, write_png
from .video import write_video

STRIPES = 80
"""Stripes of the hatching along the width of the image."""
HATCHING, TINT = np.array((1.0, 1.0, 1.0)), np.array((0.2, 0.5, 1.0))
"""Colors of stripes, and of tissue from another time."""
HATCHING_SHARE, TINT_SHARE = 0.6, 0.5
"""Their largest shares in a pixel."""
TINTED_FROM_S, FULL_TINT_S = 0.1, 2.0
"""Tissue last seen so long before or after gets some tint, and all of it."""


@dataclass(frozen=True)
class SupportPicture:
    """What one camera sees at one time, and where it is from."""

    color: NDArray[np.float32]
    """(H, W, 3) in [0, 1]: the tissue, hatched and tinted."""
    num_frames: NDArray[np.float32]
    """(H, W) training frames that saw this tissue; NaN where there is none."""
    gap_seconds: NDArray[np.float32]
    """(H, W) time to the nearest of them; infinite where no frame saw it, NaN where there is no tissue."""


class SupportMap:
    """Renders a scene with what its training frames saw of it."""

    def __init__(self, scene: Scene, frames_of: FramesOf) -> None:
        """Args: frames_of: the frames that each window was trained on."""
        self._scene, self._support = scene, Support(scene, frames_of)
        self._rasterize = render.load(scene.backend)
        self._longest = len(scene.cameras) / scene.frames_per_second

    @torch.no_grad()
    def render(self, time: float, camera: Camera) -> SupportPicture:
        """The picture at `time` in [0, 1]."""
        splats = self._scene.at(time)
        black = splats.means.new_zeros(3)
        color = self._rasterize(splats, camera, background=black).view.color.cpu().numpy()
        frames, gap = self._support.num_frames(time), self._support.gap(time)
        guessed, most, longest = ~np.isfinite(gap), max(frames.max(initial=0), 1), self._longest
        # Three numbers for each Gaussian, blended as if they were its color, in [0, 1].
        numbers = np.column_stack([frames / most, np.where(guessed, 0, gap / longest), guessed])
        out = self._rasterize(with_colors(splats, numbers), camera, background=black)
        blended, alpha = out.color.cpu().numpy(), out.alpha.cpu().numpy()
        solid = alpha > SOLID_ALPHA
        share, gap, guess = np.moveaxis(blended / np.where(solid, alpha, 1)[..., None], -1, 0)
        seconds = gap / np.maximum(1 - guess, 1e-6) * longest
        is_guess = guess > 0.5
        return SupportPicture(
            _marked(color, solid & is_guess, np.where(solid & ~is_guess, seconds, 0)),
            np.where(solid, np.where(is_guess, 0, share * most), np.nan).astype(np.float32),
            np.where(solid, np.where(is_guess, np.inf, seconds), np.nan).astype(np.float32),
        )


def _marked(color: NDArray, guessed: NDArray[np.bool_], seconds: NDArray) -> NDArray[np.float32]:
    """(H, W, 3) `color` with hatching where (H, W) `guessed`, and a tint by `seconds` (H, W)."""
    height, width = guessed.shape
    tint = TINT_SHARE * np.clip((seconds - TINTED_FROM_S) / (FULL_TINT_S - TINTED_FROM_S), 0, 1)[..., None]
    color = (1 - tint) * color + tint * TINT
    stripe = (pixel_centers(width, height).sum(-1) * STRIPES / width) % 2 < 0.7
    hatching = HATCHING_SHARE * (guessed & stripe)[..., None]
    return ((1 - hatching) * color + hatching * HATCHING).astype(np.float32)


def write_support_film(
    support: SupportMap,
    views: list[View],
    out: Path,
    video: Path,
    frames_per_second: float,
    frames: list[Frame] | None = None,
) -> None:
    """Write each view as `out/*.png`, what stands behind it as `out/*.npy`, and a video.

    The NPY is (H, W, 2) float32: `SupportPicture.num_frames` and `gap_seconds`.

    Args:
        frames: the input frames, one per view, which then stand at the left.
        video: path of the mp4.
    """

    def images() -> Iterator[NDArray[np.uint8]]:
        for k, view in enumerate(views):
            shown = support.render(*view)
            name = f"{frames[k].index if frames else k:06d}"
            with whole_file(out / f"{name}.npy") as temporary:
                np.save(temporary, np.stack([shown.num_frames, shown.gap_seconds], -1))
            parts = [label(frames[k].rgb_u8, "input")] if frames else []
            parts.append(label(to_u8(shown.color), "hatched: guessed; blue: from another time"))
            beside = tile(parts, len(parts))
            write_png(out / f"{name}.png", beside)
            yield beside

    write_video(video, images(), frames_per_second)
