"""Pictures of the viewer, (H, W, 3) of 8 bits: overlays, points as squares, and lines drawn over an image."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.geometry import project
from ..core.types import Camera

OUTLINE = (0, 255, 255)
MASK_SHARE = 0.4
"""Share of the overlay's color over a mask."""


def fitted(image: NDArray, camera: Camera) -> NDArray:
    """An image of a frame, resized to the image size of `camera`; masks stay masks."""
    size = camera.width, camera.height
    if image.shape[1::-1] == size:
        return image
    if image.dtype == np.bool_:
        return cv2.resize(image.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    nearest = image.dtype.kind == "f"  # never interpolate between a depth and a missing one
    return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA)


def with_tool(picture: NDArray[np.uint8], original: NDArray[np.uint8], tool: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A copy with the tool (H, W) of the original image on top, outlined."""
    return _outlined(np.where(tool[..., None], original, picture), tool)


def with_mask(picture: NDArray[np.uint8], tool_mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A copy of an image with a tool mask (H, W) in a transparent color, outlined."""
    picture = picture.copy()
    picture[tool_mask] = (1 - MASK_SHARE) * picture[tool_mask] + MASK_SHARE * np.array(OUTLINE)
    return _outlined(picture, tool_mask)


def _outlined(picture: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, OUTLINE, 1)
    return picture


MAX_DOT_PX = 6
"""Side of the largest square."""


def render_points(
    points: NDArray, colors: NDArray[np.uint8], size: float, camera: Camera
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """(H, W, 3) image, black where there is no point, and (H, W) z of the visible points, mm, 0 where there is none.

    Args:
        points: (P, 3) world axes, mm. colors: (P, 3). size: width of a point, mm.
    """
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    depth = np.zeros((camera.height, camera.width), np.float32)
    pixels, z = project(points.astype(np.float64), camera)
    inside = np.flatnonzero((z > 1e-3) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(-1))
    if not len(inside):
        return picture, depth
    # Far to near: for repeated indices NumPy keeps the last value.
    order = inside[np.argsort(-z[inside], kind="stable")]
    pixels, z, colors = pixels[order], z[order], colors[order]
    side = int(np.clip(np.ceil(camera.fy * size / np.median(z)), 1, MAX_DOT_PX))
    corner = np.floor(pixels - (side - 1) / 2).astype(int)
    offsets = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
    x, y = np.moveaxis(corner[:, None] + offsets, -1, 0)
    seen = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    picture[y[seen], x[seen]] = np.broadcast_to(colors[:, None], (*x.shape, 3))[seen]
    depth[y[seen], x[seen]] = np.broadcast_to(z[:, None], x.shape)[seen]
    return picture, depth


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

    def __add__(self, other: Lines) -> Lines:
        return Lines(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))


NO_LINES = Lines(np.zeros((0, 2, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, bool))


def track_lines(paths: NDArray, frame: int, sure: NDArray[np.bool_]) -> Lines:
    """Tracks over the last frames up to `frame`: faded, and without a dot, where a point is hidden or uncertain.

    Args:
        paths: (T, P, 3) world axes, mm; NaN where a point is unknown.
        sure: (T, P) False where it is hidden or uncertain.
    """
    rows = np.arange(max(frame - TRAIL_FRAMES, 0), frame + 1)
    if len(rows) == 1:  # a track of one frame is a dot
        rows = rows.repeat(2)
    bright = sure[rows[1:]]
    segments = np.stack([paths[rows[:-1]], paths[rows[1:]]], 2)  # (F, P, 2, 3)
    hues = np.linspace(0, 1, paths.shape[1], endpoint=False)
    colors = np.array([[round(255 * c) for c in colorsys.hsv_to_rgb(h, 0.75, 1)] for h in hues], np.uint8)
    colors = np.where(bright[..., None], colors, (FADED * colors).astype(np.uint8))
    dots = bright & (rows[1:] == frame)[:, None]
    known = np.isfinite(segments).all((2, 3))
    return Lines(segments[known], colors[known], dots[known])


def ruler(ends: NDArray) -> Lines:
    """The line through measured points (K, 3); a single point is a dot."""
    chain = np.concatenate([ends[:1], ends])
    segments = np.stack([chain[:-1], chain[1:]], 1)
    return Lines(segments, np.full((len(segments), 3), RULER_COLOR, np.uint8), np.ones(len(segments), bool))


def draw_lines(picture: NDArray[np.uint8], camera: Camera, lines: Lines) -> NDArray[np.uint8]:
    """A copy of the image of `camera` with the lines drawn over it, without those behind the camera."""
    picture = np.ascontiguousarray(picture).copy()
    pixels, z = project(lines.segments, camera)
    width = max(round(camera.height / 350), 1)
    reach = 4 * max(camera.width, camera.height)
    drawable = (z > 0).all(1) & (np.abs(pixels) <= reach).all((1, 2))
    # Sixteenths of a pixel; OpenCV counts pixel centers from 0.
    fixed = np.rint((pixels[drawable] - 0.5) * 16).astype(int).tolist()
    for (a, b), color, dot in zip(fixed, lines.colors[drawable].tolist(), lines.dots[drawable], strict=True):
        cv2.line(picture, a, b, color, width, cv2.LINE_AA, 4)
        if dot:
            cv2.circle(picture, b, 16 * (width + 1), color, -1, cv2.LINE_AA, 4)
    return picture
