"""What the endoscope records of one frame: rendered in linear light, exposed by the camera, disturbed by events."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import AT_ORIGIN, CameraPose
from .events import Event, disturbed, is_mirrored, shows_body
from .scene import PhantomScene, SceneState
from .sensor import develop, expose, exposure_gain, metered, next_gain, stereo_depth
from .views import RenderedView, pixel_hits, render_view

RIM = np.ones((3, 3), np.uint8)
"""Masks cover the tool's blended rim and one pixel more, as annotators' outlines do."""


@dataclass(frozen=True)
class RenderedFrame:
    """One frame before the camera exposes it."""

    index: int
    now: SceneState
    view: RenderedView
    z: NDArray[np.float32]
    """(H, W) z of the tissue, behind tools too, mm."""
    tool_mask: NDArray[np.bool_]
    """(H, W) True on tools."""


def render_frame(scene: PhantomScene, index: int) -> RenderedFrame:
    """Render frame `index` of the endoscope's left camera."""
    now = SceneState.of(scene, index / (scene.cfg.frames - 1))
    view = render_view(scene, now, AT_ORIGIN)
    tool_mask = cv2.dilate((view.tool_share > 0).astype(np.uint8), RIM) > 0
    return RenderedFrame(index, now, view, pixel_hits(now.vertices, scene.cfg)[..., 2], tool_mask)


@dataclass(frozen=True)
class Exposure:
    """Gain of the camera."""

    first: float
    """Of the first frame, and of the truth of all frames."""
    now: float
    wanted: float
    """Exposed radiance that automatic gain keeps."""

    @staticmethod
    def of_first(scene: PhantomScene, frame: RenderedFrame) -> Exposure:
        """The gain of the first frame."""
        gain = exposure_gain(frame.view.tissue) * scene.look.exposure
        return Exposure(gain, gain, gain * metered(frame.view.image))

    def after(self, frame: RenderedFrame) -> Exposure:
        """The gain that automatic gain gives the frame after this one."""
        return replace(self, now=next_gain(self.now, metered(frame.view.image), self.wanted))


@dataclass(frozen=True)
class RecordedFrame:
    """The files of one frame."""

    image: NDArray[np.uint8]
    """(H, W, 3)."""
    tool_mask: NDArray[np.bool_]
    """(H, W) True on tools."""
    depth: NDArray[np.float32]
    """(H, W) measured z, mm; 0 where it is missing."""
    right: NDArray[np.uint8] | None
    """(H, W, 3) image of the right camera; None without stereo."""


def record(scene: PhantomScene, frame: RenderedFrame, gain: float, lens: NDArray[np.float32]) -> RecordedFrame:
    """Expose a frame, with sensor noise, and measure its depth. Args: lens: see `sensor.vignette`."""
    cfg = scene.cfg
    rng = np.random.default_rng([cfg.seed, 6, frame.index])
    image = expose(develop(frame.view.image, gain, lens), cfg.noise, rng)
    depth = stereo_depth(np.minimum(frame.z, frame.view.tool_depth), image, cfg, rng)
    return RecordedFrame(image, frame.tool_mask, depth, _right_image(scene, frame, gain, lens) if cfg.stereo else None)


def _right_image(
    scene: PhantomScene, frame: RenderedFrame, gain: float, lens: NDArray[np.float32]
) -> NDArray[np.uint8]:
    cfg = scene.cfg
    view = render_view(scene, frame.now, CameraPose.moved_right(cfg.baseline_mm))
    return expose(develop(view.image, gain, lens), cfg.noise, np.random.default_rng([cfg.seed, 7, frame.index]))


def with_events(recorded: RecordedFrame, events: tuple[Event, ...], index: int, seed: int) -> RecordedFrame:
    """The files of frame `index` as its events leave them."""
    rows, sees_tissue = rows_after_cuts(events, index), shows_body(events, index)

    def seen(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return disturbed(np.ascontiguousarray(image[rows]), events, index, seed)

    tool_mask, depth = np.ascontiguousarray(recorded.tool_mask[rows]), np.ascontiguousarray(recorded.depth[rows])
    return RecordedFrame(
        seen(recorded.image),
        tool_mask if sees_tissue else np.zeros_like(tool_mask),
        depth if sees_tissue else np.zeros_like(depth),
        None if recorded.right is None else seen(recorded.right),
    )


def rows_after_cuts(events: tuple[Event, ...], index: int) -> slice:
    """The rows of frame `index`, from bottom to top behind a cut."""
    return slice(None, None, -1) if is_mirrored(events, index) else slice(None)
