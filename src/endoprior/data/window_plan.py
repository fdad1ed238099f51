"""Where a sequence is cut into windows: by the path of the camera, by the picture, and by length."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ..core.types import Camera
from .sequence import FrameSequence, FrameSummaries

TURN_DEGREES = 15.0
"""A window ends where the camera has turned by this since the window's first frame, degrees, ..."""
SHIFT_SHARE = 0.1
"""... or has moved by this share of the median depth ..."""
PICTURE_CHANGE = 0.05
"""... or, where the camera moves at all, the picture differs by this: mean absolute difference of color."""
SHORTEST = 40
"""These rules count from this frame of a window on."""
OVERLAP = 20
"""Frames that a window shares with the next one: in the middle half of them one fades into the other. With ten frames a
window is worse by up to 4 dB near its end."""
THUMBNAIL = (32, 24)  # (width, height) of the pictures that are compared, px: noise and texture are averaged out


def summarize_frames(sequence: FrameSequence) -> FrameSummaries:
    """Decode every training frame once; a held-out frame counts as the training frame before it, or the first one."""
    if sequence.summaries is None:
        sequence.summaries = _summarize_frames(sequence)
    return sequence.summaries


def _summarize_frames(sequence: FrameSequence) -> FrameSummaries:
    training = np.array(sequence.indices("train"))
    thumbnails = np.zeros((len(training), *THUMBNAIL[::-1], 3), np.float32)
    depth_mm = np.full(len(training), np.nan)
    for position, frame in enumerate(sequence.frames("train")):
        small = cv2.resize(frame.rgb_u8, THUMBNAIL, interpolation=cv2.INTER_AREA)
        thumbnails[position] = small.astype(np.float32) / 255
        measured = frame.depth[frame.depth_valid & frame.tissue_mask]
        depth_mm[position] = np.median(measured) if measured.size else np.nan
    shown = np.maximum(np.searchsorted(training, np.arange(len(sequence)), "right") - 1, 0)
    return FrameSummaries(thumbnails[shown], depth_mm[shown])


def plan_windows(cameras: Sequence[Camera], summaries: FrameSummaries, longest: int) -> list[tuple[int, int]]:
    """First frame and the frame after the last one of every window, in order; one window if nothing asks for more.

    A window goes on beyond the frame that ends it until it shares frames with the next one.

    Args:
        longest: most frames of a window; 0: one window. Windows that have to be short overlap less.
    """
    num = len(cameras)
    if not longest:
        return [(0, num)]
    shortest = min(SHORTEST, longest)
    overlap = min(OVERLAP, shortest // 2)
    rotations = np.stack([camera.world_to_camera[:3, :3] for camera in cameras])
    centers = np.stack([camera.center for camera in cameras])
    moving = bool(np.ptp(centers, axis=0).any() or np.ptp(rotations, axis=0).any())
    usual_mm = float(np.nanmedian(summaries.depth_mm)) if np.isfinite(summaries.depth_mm).any() else np.inf

    def has_changed(first: int, index: int) -> bool:
        """Whether one of the rules ends a window that starts at `first` before frame `index`."""
        depth_mm = summaries.depth_mm[first] if np.isfinite(summaries.depth_mm[first]) else usual_mm
        cosine = (np.trace(rotations[first] @ rotations[index].T) - 1) / 2
        return bool(
            np.degrees(np.arccos(np.clip(cosine, -1, 1))) > TURN_DEGREES
            or np.linalg.norm(centers[index] - centers[first]) > SHIFT_SHARE * depth_mm
            or np.abs(summaries.thumbnails[index] - summaries.thumbnails[first]).mean() > PICTURE_CHANGE
        )

    starts, first = [0], 0
    for index in range(1, num):
        length = index - first
        if num - index < shortest:  # what is left would be too short a window
            if num - first > longest and num - shortest >= first + overlap:
                starts.append(num - shortest)
            break
        if (moving and length >= shortest and has_changed(first, index)) or length + overlap >= longest:
            first = index
            starts.append(first)
    stops = [min(start + overlap, num) for start in starts[1:]] + [num]
    return list(zip(starts, stops, strict=True))
