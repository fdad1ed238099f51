"""Where material points go: in truth, as the scene carries them, by chained optical flow, and without motion.

Shared letters: `T` frames, `P` points. Points are in camera axes of their frame, mm; pixels in px of the frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import back_project, bilinear, camera_to_world, cells_at, project
from ..core.types import Camera, Frame
from ..data import FrameSequence
from ..footage.optical_flow import MIN_SIZE_PX, fine_flow, fine_shrink, gray_for_flow
from ..model.carry import carry_points
from ..model.scene import Scene
from ..model.surface import project_visible, render_surface, shown_pixels
from ..system.memory import workers
from .score import ScoreUnavailable

RETURN_PX, RETURN_SHARE = 1.0, 0.05
"""Chained flow loses a point where flow and backward flow disagree by more than this, plus this share of the step."""
FLOW_BYTES = 40
"""Memory per pixel while the flow of a pair of frames is computed, bytes."""
FLOW_CHUNK = 16
"""Number of frame pairs whose flow is computed together."""
TOO_SMALL = f"frames are smaller than {MIN_SIZE_PX} px, the least for optical flow"


@dataclass(frozen=True)
class TrueTracks:
    """Every true point that is visible in two frames."""

    points: NDArray[np.float64]
    """(T, P, 3) mm."""
    pixels: NDArray[np.float64]
    """(T, P, 2) px."""
    visible: NDArray[np.bool_]
    """(T, P) True where the point is seen."""
    region: NDArray[np.str_] | None
    """(P,) part of the tissue each point lies in, if the truth says so."""

    @property
    def first(self) -> NDArray[np.intp]:
        """(P,) frame each point starts in: the first that shows it."""
        return self.visible.argmax(0)

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(T, P) True after the frame the point starts in."""
        return np.arange(len(self.visible))[:, None] > self.first

    def at_start(self, values: NDArray) -> NDArray:
        """(P, ...) of (T, P, ...) values: those of the frame in which each point starts."""
        return values[self.first, np.arange(values.shape[1])]


@dataclass(frozen=True)
class PredictedTracks:
    """Positions of the same points by one method; only those after the frame a point starts in count."""

    points: NDArray[np.floating]
    """(T, P, 3) mm."""
    pixels: NDArray[np.floating]
    """(T, P, 2) px; infinite where the point is behind the camera."""
    visible: NDArray[np.bool_]
    """(T, P) whether the method says that the frame shows the point."""


def true_tracks(sequence: FrameSequence) -> TrueTracks | None:
    """The paired tracks of the ground truth; None if there are none with two frames that show the same point."""
    tracks = sequence.truth and sequence.truth.tracks
    if not tracks or not tracks.paired:
        return None
    chosen = tracks.visible.sum(0) > 1
    if not chosen.any():
        return None
    points = tracks.points[:, chosen].astype(np.float64)
    pixels = np.stack([_pixels(p, sequence.camera(i)) for i, p in enumerate(points)])
    return TrueTracks(
        points, pixels, tracks.visible[:, chosen], None if tracks.region is None else tracks.region[chosen]
    )


def by_scene(scene: Scene, true: TrueTracks, sequence: FrameSequence) -> PredictedTracks:
    """Points carried by the Gaussians; visible where neither rendered tissue nor the tool mask hides them."""
    world = carry_points(
        scene, _world_starts(true, sequence), true.first, [i / len(sequence) for i in range(len(sequence))]
    )
    tracks = _in_frames(world, sequence)
    for i, frame in enumerate(sequence.frames("video")):
        tracks.visible[i] &= project_visible(world[i], render_surface(scene, frame.time, frame.camera))[1]
    return tracks


def without_motion(true: TrueTracks, sequence: FrameSequence) -> PredictedTracks:
    """Points that stay where they start; with a moving camera, where they start in the world."""
    starts = _world_starts(true, sequence)
    return _in_frames(np.broadcast_to(starts, (len(sequence), *starts.shape)), sequence)


def by_chained_flow(true: TrueTracks, sequence: FrameSequence) -> PredictedTracks:
    """Points moved from frame to frame by optical flow (DIS), held-out frames included; a lost point moves on too.

    A point is visible in a frame unless it is outside of the image, under the tool mask, or the backward flow does not
    return to where it came from. Its depth is the measured one at its pixel, else the last known one.

    Raises:
        ScoreUnavailable: the frames are too small for optical flow.
    """
    frames = sequence.frames("video")
    if min(sequence.camera(0).width, sequence.camera(0).height) < MIN_SIZE_PX:
        raise ScoreUnavailable(TOO_SMALL)
    first, depth = true.first, true.at_start(true.points)[:, 2]
    pixels = np.tile(true.at_start(true.pixels), (len(sequence), 1, 1))
    points, visible = np.tile(true.at_start(true.points), (len(sequence), 1, 1)), np.zeros_like(true.visible)
    for k, (there, back) in enumerate(_flows(frames)):
        frame, moving = frames[k + 1], first <= k
        step = _flow_at(there, pixels[k], frame)
        pixels[k + 1] = np.where(moving[:, None], pixels[k] + step, pixels[k])
        gap = np.linalg.norm(step + _flow_at(back, pixels[k + 1], frame), axis=-1)
        returns = gap <= RETURN_PX + RETURN_SHARE * np.linalg.norm(step, axis=-1)
        shown = shown_pixels(pixels[k + 1], frame.tissue_mask)
        x, y = cells_at(pixels[k + 1], frame.camera.width, frame.camera.height)
        depth = np.where(moving & shown & frame.depth_valid[y, x], frame.depth[y, x], depth)
        points[k + 1] = back_project(pixels[k + 1], depth, _at_origin(frame.camera))
        visible[k + 1] = moving & shown & returns
    return PredictedTracks(points, pixels, visible)


def _in_frames(world: NDArray[np.floating], sequence: FrameSequence) -> PredictedTracks:
    """World points (T, P, 3) as each frame's camera sees them, visible where the frame shows tissue."""
    points, pixels, visible = [], [], []
    for at, frame in zip(world, sequence.frames("video"), strict=True):
        pose = frame.camera.world_to_camera
        points.append(at @ pose[:3, :3].T + pose[:3, 3])
        pixels.append(_pixels(points[-1], frame.camera))
        visible.append(shown_pixels(pixels[-1], frame.tissue_mask))
    return PredictedTracks(np.stack(points), np.stack(pixels), np.stack(visible))


def _world_starts(true: TrueTracks, sequence: FrameSequence) -> NDArray[np.float64]:
    """(P, 3) world position of each point in the frame it starts in, mm."""
    to_world = camera_to_world(sequence.camera(i) for i in range(len(sequence)))[true.first]
    return np.einsum("pij,pj->pi", to_world[:, :3, :3], true.at_start(true.points)) + to_world[:, :3, 3]


def _at_origin(camera: Camera) -> Camera:
    return replace(camera, world_to_camera=np.eye(4))


def _pixels(points: NDArray[np.floating], camera: Camera) -> NDArray[np.floating]:
    """(P, 2) pixels of points in camera axes; infinite behind the camera."""
    pixels, z = project(points, _at_origin(camera))
    return np.where((z > 0)[:, None], pixels, np.inf)


def _flow_at(flow: NDArray[np.float32], pixels: NDArray[np.floating], frame: Frame) -> NDArray[np.float64]:
    """(P, 2) flow at pixels of the frame, in px of the frame; at a border beyond the image."""
    scale = np.array([frame.camera.width / flow.shape[1], frame.camera.height / flow.shape[0]])
    return bilinear(flow, pixels / scale) * scale


def _flows(frames: Sequence[Frame]) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """The flows from frame k to k + 1 and back: the same fine flow from which training starts."""
    camera = frames[0].camera
    shrink = fine_shrink(camera.height, camera.width)

    def pair(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return fine_flow(first, second), fine_flow(second, first)

    with ThreadPoolExecutor(workers(FLOW_BYTES * camera.width * camera.height)) as pool:  # OpenCV releases the lock
        for start in range(0, len(frames) - 1, FLOW_CHUNK):
            chunk = range(start, min(start + FLOW_CHUNK + 1, len(frames)))
            grays = [gray_for_flow(frames[k].rgb_u8, shrink) for k in chunk]
            yield from pool.map(pair, grays[:-1], grays[1:])
