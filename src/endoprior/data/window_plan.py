"""Where a sequence is cut into windows: by the path of the camera, by the picture, and by length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.config import WindowConfig
from ..core.types import Camera
from .sequence import FrameSequence

THUMBNAIL = (32, 24)  # (width, height) of the pictures that are compared, px: noise and texture are averaged out


@dataclass(frozen=True)
class Looks:
    """What the frames show, in short; `T` frames."""

    thumbnails: NDArray[np.float32]  # (T, h, w, 3) color in [0, 1]
    depth_mm: NDArray[np.float64]  # (T,) median of the measured depth; NaN without


def look_through(sequence: FrameSequence) -> Looks:
    """Decode every training frame once; a held-out frame counts as the training frame before it, or the first one."""
    training = np.array(sequence.indices("train"))
    thumbnails = np.zeros((len(training), *THUMBNAIL[::-1], 3), np.float32)
    depth_mm = np.full(len(training), np.nan)
    for position, frame in enumerate(sequence.frames("train")):
        small = cv2.resize(frame.rgb_u8, THUMBNAIL, interpolation=cv2.INTER_AREA)
        thumbnails[position] = small.astype(np.float32) / 255
        measured = frame.depth[frame.depth_valid & frame.tissue_mask]
        depth_mm[position] = np.median(measured) if measured.size else np.nan
    shown = np.maximum(np.searchsorted(training, np.arange(len(sequence)), "right") - 1, 0)
    return Looks(thumbnails[shown], depth_mm[shown])


def plan_windows(cameras: Sequence[Camera], looks: Looks, cfg: WindowConfig) -> list[tuple[int, int]]:
    """First frame and the frame after the last one of every window, in order; one window if nothing asks for more.

    A window goes on beyond the frame that ends it until it shares `overlap` frames with the next one.
    """
    num = len(cameras)
    if not cfg.enabled:
        return [(0, num)]
    rotations = np.stack([camera.world_to_camera[:3, :3] for camera in cameras])
    centers = np.stack([camera.center for camera in cameras])
    moving = bool(np.ptp(centers, axis=0).any() or np.ptp(rotations, axis=0).any())
    usual_mm = float(np.nanmedian(looks.depth_mm)) if np.isfinite(looks.depth_mm).any() else np.inf

    def has_changed(first: int, index: int) -> bool:
        """Whether one of the rules ends a window that starts at `first` before frame `index`."""
        depth_mm = looks.depth_mm[first] if np.isfinite(looks.depth_mm[first]) else usual_mm
        cosine = (np.trace(rotations[first] @ rotations[index].T) - 1) / 2
        return bool(
            np.degrees(np.arccos(np.clip(cosine, -1, 1))) > cfg.turn_degrees
            or np.linalg.norm(centers[index] - centers[first]) > cfg.shift_share * depth_mm
            or np.abs(looks.thumbnails[index] - looks.thumbnails[first]).mean() > cfg.picture_change
        )

    starts, first = [0], 0
    for index in range(1, num):
        length = index - first
        if num - index < cfg.shortest:  # what is left would be too short a window
            if num - first > cfg.longest and num - cfg.shortest >= first + cfg.overlap:
                starts.append(num - cfg.shortest)
            break
        if (moving and length >= cfg.shortest and has_changed(first, index)) or length + cfg.overlap >= cfg.longest:
            first = index
            starts.append(first)
    stops = [min(start + cfg.overlap, num) for start in starts[1:]] + [num]
    return list(zip(starts, stops, strict=True))
