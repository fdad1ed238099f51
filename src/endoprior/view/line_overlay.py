"""3D lines drawn over the image: tracks of material points, and the measured distance."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.geometry import project
from ..core.types import Camera

TRAIL_FRAMES = 8
"""Length of a drawn track, frames."""
FADED = 0.4
"""Brightness of a track where its point is hidden or uncertain, as a share."""
RULER_COLOR = (255, 255, 0)


@dataclass(frozen=True)
class Lines:
    """S line segments, optionally with a dot at their second end."""

    segments: NDArray[np.float64]
    """(S, 2, 3) both ends, world axes, mm."""
    colors: NDArray[np.uint8]
    """(S, 3)."""
    dots: NDArray[np.bool_]
    """(S,) True where the second end has a dot."""

    def __len__(self) -> int:
        return len(self.segments)


def no_lines() -> Lines:
    """An empty set of lines."""
    return Lines(np.zeros((0, 2, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, bool))


def concatenated(a: Lines, b: Lines) -> Lines:
    """The lines of `a` and `b`."""
    parts = ((getattr(a, name), getattr(b, name)) for name in ("segments", "colors", "dots"))
    return Lines(*(np.concatenate(pair) for pair in parts))


def track_lines(paths: NDArray, frame: int, sure: NDArray[np.bool_]) -> Lines:
    """Tracks over the last frames up to `frame`: faded, and without a dot, where a point is hidden or uncertain.

    Args:
        paths: (T, P, 3) world axes, mm; NaN where a point is unknown.
        sure: (T, P) False where it is hidden or uncertain.
    """
    first = max(frame - TRAIL_FRAMES, 0)
    shown, bright = paths[first : frame + 1], sure[first : frame + 1]
    if len(shown) == 1:  # a track of one frame is a dot
        shown, bright = np.concatenate([shown, shown]), np.concatenate([bright, bright])
    segments = np.stack([shown[:-1], shown[1:]], 2)  # (F, P, 2, 3)
    num_steps, num_points = segments.shape[:2]
    hues = np.linspace(0, 1, num_points, endpoint=False)
    colors = np.array([[round(255 * c) for c in colorsys.hsv_to_rgb(h, 0.75, 1)] for h in hues], np.uint8)
    colors = np.where(bright[1:, :, None], colors, (FADED * colors).astype(np.uint8))
    dots = ((np.arange(num_steps) == num_steps - 1)[:, None] & bright[1:]).ravel()
    known = np.isfinite(segments).all((2, 3)).ravel()
    parts = segments.reshape(-1, 2, 3), colors.reshape(-1, 3), dots
    return Lines(*(part[known] for part in parts))


def ruler(ends: NDArray) -> Lines:
    """The line between the measured points `ends` (1 or 2, 3); a single point is a dot."""
    chain = np.concatenate([ends[:1], ends]) if len(ends) else np.zeros((0, 3))
    segments = np.stack([chain[:-1], chain[1:]], 1) if len(chain) else np.zeros((0, 2, 3))
    return Lines(segments, np.tile(np.uint8(RULER_COLOR), (len(segments), 1)), np.ones(len(segments), bool))


def draw_lines(picture: NDArray[np.uint8], camera: Camera, marks: Lines) -> NDArray[np.uint8]:
    """A copy of the (H, W, 3) image of `camera` with the lines drawn over it, without those behind the camera."""
    picture = np.ascontiguousarray(picture).copy()
    pixels, z = project(marks.segments, camera)
    width = max(round(camera.height / 350), 1)
    reach = 4 * max(camera.width, camera.height)
    for ends, depth, color, dot in zip(pixels, z, marks.colors.tolist(), marks.dots, strict=True):
        if (depth <= 0).any() or (np.abs(ends) > reach).any():
            continue
        # Sixteenths of a pixel; OpenCV counts pixel centers from 0.
        a, b = (tuple(np.rint((end - 0.5) * 16).astype(int).tolist()) for end in ends)
        cv2.line(picture, a, b, color, width, cv2.LINE_AA, 4)
        if dot:
            cv2.circle(picture, b, 16 * (width + 1), color, -1, cv2.LINE_AA, 4)
    return picture
