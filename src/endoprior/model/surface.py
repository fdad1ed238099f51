"""The tissue surface that a camera sees at one time, and which training frames saw the tissue.

What no frame saw is carried from another time, or a guess.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import back_project, bilinear, cells_at, expected_depth, project
from ..core.types import SURE_DEPTH, Camera, Frame
from .scene import Scene, SingleScene, Window

HIDDEN_SHARE = 0.04
"""A point is hidden if it lies deeper than the rendered surface at its pixel by more than this share (docs/log.md)."""


@dataclass(frozen=True)
class Surface:
    """What one camera sees; 0 where no surface is rendered."""

    depth: NDArray[np.float32]  # (H, W) z, mm
    color: NDArray[np.float32]  # (H, W, 3) in [0, 1], without the background
    camera: Camera


def render_surface(scene: Scene, time: float, camera: Camera, min_alpha: float = 0.5) -> Surface:
    """Render `scene` and divide depth and color by the accumulated opacity where that is at least `min_alpha`."""
    out = scene.render(time, camera)
    alpha = out.alpha.cpu().numpy()
    opaque = alpha[..., None] >= min_alpha
    behind = (1 - alpha[..., None]) * np.asarray(scene.background, np.float32)
    color = np.where(opaque, (out.unclamped_color.cpu().numpy() - behind) / np.where(opaque, alpha[..., None], 1), 0)
    depth = expected_depth(out.depth.cpu().numpy(), alpha, min_alpha)
    return Surface(depth, color.clip(0, 1).astype(np.float32), camera)


def depth_at(surface: Surface, pixels: NDArray) -> NDArray[np.float64]:
    """(P,) depth between the pixel centers around (P, 2) pixels; NaN where one of them shows no surface."""
    depth = np.where(surface.depth > 0, surface.depth, np.nan).astype(np.float64)
    return bilinear(depth, pixels)


def surface_points(
    scene: Scene, pixels: NDArray, frames: NDArray[np.intp], min_alpha: float = 0.5
) -> NDArray[np.float64]:
    """(P, 3) points of the rendered surface at (P, 2) pixels of (P,) frames, world, mm; NaN where there is none.

    Args:
        min_alpha: as of `render_surface`.
    """
    points = np.empty((len(pixels), 3))
    for frame in np.unique(frames):
        own, camera = np.flatnonzero(frames == frame), scene.cameras[frame]
        depth = depth_at(render_surface(scene, scene.frame_time(frame), camera, min_alpha), pixels[own])
        points[own] = back_project(pixels[own], depth, camera)
    return points


def shown_pixels(pixels: NDArray, tissue_mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(P,) whether (P, 2) pixels are inside the image and on tissue.

    Args:
        tissue_mask: (H, W) False under tools.
    """
    height, width = tissue_mask.shape
    x, y = cells_at(pixels, width, height)
    return (pixels >= 0).all(1) & (pixels <= (width, height)).all(1) & tissue_mask[y, x]


def project_visible(
    points: NDArray, surface: Surface, tissue_mask: NDArray[np.bool_] | None = None
) -> tuple[NDArray, NDArray[np.bool_]]:
    """(P, 2) pixels of world points (P, 3), and (P,) whether the image shows them.

    It does where they are inside the image and neither behind rendered tissue nor under a tool.

    Args:
        tissue_mask: (H, W) False under tools; None: no tools.
    """
    pixels, z = project(points.astype(np.float64), surface.camera)
    mask = np.ones(surface.depth.shape, bool) if tissue_mask is None else tissue_mask
    depth = depth_at(surface, pixels)
    with np.errstate(invalid="ignore"):  # NaN: no surface, so nothing is visible
        return pixels, (z > 0) & shown_pixels(pixels, mask) & (z <= depth * (1 + HIDDEN_SHARE))


FramesOf = Callable[[Window], Iterable[Frame]]
"""The frames that a window was trained on; their times count from its start (`FrameSequence.part`)."""


@dataclass(frozen=True)
class WindowSupport:
    """Which of its `F` frames show each of the `N` Gaussians of a window: on tissue, in the image, and not hidden."""

    seen: NDArray[np.bool_]
    """(N, F)."""
    positions: NDArray[np.float64]
    """(F,) of these frames, counted from the start of the window."""
    depth_is_guess: NDArray[np.bool_]
    """(N,) whether the frames that show it do not measure its depth; False where they do not say."""

    @property
    def num_frames(self) -> NDArray[np.int64]:
        """(N,) frames that show it; 0: a guess."""
        return self.seen.sum(1)

    def gap(self, position: float) -> NDArray[np.float64]:
        """(N,) frames from `position` to the nearest one that shows it; infinite for a guess."""
        distance = np.where(self.seen, np.abs(self.positions - position), np.inf)
        return distance.min(1, initial=np.inf)


class Support:
    """The support of the Gaussians that a scene shows at each time, in the order of `Scene.at`."""

    def __init__(self, scene: Scene, frames_of: FramesOf) -> None:
        """Args: frames_of: what each window was trained on; asked when it is shown first."""
        self._scene, self._frames_of = scene, frames_of
        self._windows: dict[int, WindowSupport] = {}

    def _of(self, window: Window) -> WindowSupport:
        if window.start not in self._windows:
            self._windows[window.start] = window_support(window.scene, self._frames_of(window))
        return self._windows[window.start]

    def share(self, time: float) -> NDArray[np.float64]:
        """(N,) share of the training frames of its window that show each Gaussian."""
        parts = [self._of(shown.window) for shown in self._scene.shown_at(time)]
        return np.concatenate([part.num_frames / max(len(part.positions), 1) for part in parts])

    def num_frames(self, time: float) -> NDArray[np.int64]:
        """(N,) training frames that show each Gaussian; 0: a guess."""
        return np.concatenate([self._of(shown.window).num_frames for shown in self._scene.shown_at(time)])

    def depth_is_guess(self, time: float) -> NDArray[np.bool_]:
        """(N,) whether the frames that show each Gaussian do not measure its depth."""
        return np.concatenate([self._of(shown.window).depth_is_guess for shown in self._scene.shown_at(time)])

    def gap(self, time: float) -> NDArray[np.float64]:
        """(N,) seconds from `time` to the nearest frame that shows each Gaussian; infinite for a guess."""
        shown = self._scene.shown_at(time)
        gaps = [self._of(s.window).gap(s.time * (s.window.stop - s.window.start)) for s in shown]
        return np.concatenate(gaps) / self._scene.frames_per_second


def window_support(scene: SingleScene, frames: Iterable[Frame]) -> WindowSupport:
    """The support of one window in the `frames` that it was trained on."""
    seen, positions = [np.zeros((len(scene), 0), bool)], []
    confidence, told = np.zeros(len(scene)), np.zeros(len(scene))  # sums over the frames that show a Gaussian
    for frame in frames:
        means = scene.at(frame.time).means.cpu().numpy()
        surface = render_surface(scene, frame.time, frame.camera)
        pixels, shown = project_visible(means, surface, frame.tissue_mask)
        seen.append(shown[:, None])
        positions.append(frame.time * len(scene.cameras))
        if frame.depth_confidence is not None:
            x, y = cells_at(pixels[shown], frame.camera.width, frame.camera.height)
            confidence[shown] += frame.depth_confidence[y, x]
            told[shown] += 1
    return WindowSupport(np.hstack(seen), np.array(positions, np.float64), confidence < SURE_DEPTH * told)
