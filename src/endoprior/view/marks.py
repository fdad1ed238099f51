"""Lines in space that are drawn over the picture: where material points came from, and the measured distance."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.geometry import project
from ..core.types import Camera

TRAIL_FRAMES = 8
"""Frames back that a track shows."""
RULER_COLOR = (255, 255, 0)


@dataclass(frozen=True)
class Marks:
    """S line segments with knobs at their ends."""

    segments: NDArray[np.float64]
    """(S, 2, 3) both ends, world axes, mm."""
    colors: NDArray[np.uint8]
    """(S, 3)."""
    knobs: NDArray[np.bool_]
    """(S,) True where the second end carries a dot."""

    def __len__(self) -> int:
        return len(self.segments)


def no_marks() -> Marks:
    """Nothing to draw."""
    return Marks(np.zeros((0, 2, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, bool))


def joined(a: Marks, b: Marks) -> Marks:
    """Both."""
    parts = ((getattr(a, name), getattr(b, name)) for name in ("segments", "colors", "knobs"))
    return Marks(*(np.concatenate(pair) for pair in parts))


def trails(paths: NDArray, frame: int) -> Marks:
    """The tracks `paths` (T, P, 3) of the last frames up to `frame`; NaN where a point is not known."""
    first = max(frame - TRAIL_FRAMES, 0)
    shown = paths[first : frame + 1]
    if len(shown) == 1:  # a trail of no length still has its knob
        shown = np.concatenate([shown, shown])
    segments = np.stack([shown[:-1], shown[1:]], 2)  # (F, P, 2, 3)
    num_steps, num_points = segments.shape[:2]
    hues = np.linspace(0, 1, num_points, endpoint=False)
    colors = np.array([[round(255 * c) for c in colorsys.hsv_to_rgb(h, 0.75, 1)] for h in hues], np.uint8)
    knobs = np.repeat(np.arange(num_steps) == num_steps - 1, num_points)
    known = np.isfinite(segments).all((2, 3)).ravel()
    marks = segments.reshape(-1, 2, 3), np.tile(colors.reshape(-1, 3), (num_steps, 1)), knobs
    return Marks(*(part[known] for part in marks))


def ruler(ends: NDArray) -> Marks:
    """The line between the measured points `ends` (1 or 2, 3); one point alone is a dot."""
    chain = np.concatenate([ends[:1], ends]) if len(ends) else np.zeros((0, 3))
    segments = np.stack([chain[:-1], chain[1:]], 1) if len(chain) else np.zeros((0, 2, 3))
    return Marks(segments, np.tile(np.uint8(RULER_COLOR), (len(segments), 1)), np.ones(len(segments), bool))


def draw_marks(picture: NDArray[np.uint8], camera: Camera, marks: Marks) -> NDArray[np.uint8]:
    """A copy of the (H, W, 3) picture of `camera` with the marks over it; those behind the camera are left out."""
    picture = np.ascontiguousarray(picture).copy()
    pixels, z = project(marks.segments, camera)
    width = max(round(camera.height / 350), 1)
    reach = 4 * max(camera.width, camera.height)
    for ends, depth, color, knob in zip(pixels, z, marks.colors.tolist(), marks.knobs, strict=True):
        if (depth <= 0).any() or (np.abs(ends) > reach).any():
            continue
        # Sixteenths of a pixel; OpenCV counts pixel centers from 0.
        a, b = (tuple(np.rint((end - 0.5) * 16).astype(int).tolist()) for end in ends)
        cv2.line(picture, a, b, color, width, cv2.LINE_AA, 4)
        if knob:
            cv2.circle(picture, b, 16 * (width + 1), color, -1, cv2.LINE_AA, 4)
    return picture
