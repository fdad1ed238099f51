"""Pictures of the viewer: each layer as an (H, W, 3) 8-bit image, points as squares, and lines drawn over the image."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.geometry import project
from ..core.types import Camera
from ..visualization.image_tools import SOLID_ALPHA, colorize

LARGEST_DIFFERENCE = 0.25
"""Mean absolute color difference that is shown in red."""
OUTLINE = (0, 255, 255)
MASK_SHARE = 0.4
"""Share of the overlay's color over a mask."""


def fitted(image: NDArray, camera: Camera) -> NDArray:
    """An image of a frame, resized to the image size of `camera`; masks stay masks."""
    if image.shape[:2] == (camera.height, camera.width):
        return image
    if image.dtype == np.bool_:
        return cv2.resize(image.astype(np.uint8), (camera.width, camera.height), interpolation=cv2.INTER_NEAREST) > 0
    nearest = image.dtype.kind == "f"  # never interpolate between a depth and a missing one
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_AREA
    return cv2.resize(image, (camera.width, camera.height), interpolation=how)


def depth_picture(depth: NDArray, span: tuple[float, float]) -> NDArray[np.uint8]:
    """Turbo colors from the nearest to the farthest depth of `span`, mm; black where there is none."""
    return colorize(depth, *span, depth > 0)


def value_picture(value: NDArray, known: NDArray) -> NDArray[np.uint8]:
    """Turbo colors of composited values in [0, 1].

    Args:
        value: (H, W) composited values of the Gaussians whose value is known.
        known: (H, W) alpha of these alone; black where it is low: no surface, or nothing known of it.
    """
    return colorize(value / np.maximum(known, 1e-6), 0, 1, known > SOLID_ALPHA)


def difference_picture(rendered: NDArray[np.uint8], original: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Turbo colors of the mean absolute difference of two (H, W, 3) images."""
    difference = cv2.absdiff(rendered, original).mean(-1) / 255
    return colorize(difference, 0, LARGEST_DIFFERENCE)


def with_tool(
    picture: NDArray[np.uint8], original: NDArray[np.uint8], tissue_mask: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """A copy with the tool of the original image on top, outlined."""
    picture = np.where(tissue_mask[..., None], picture, original)
    return outlined(picture, ~tissue_mask)


def with_mask(picture: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A copy of an (H, W, 3) image with a mask (H, W) in a transparent color, outlined."""
    picture = picture.copy()
    picture[mask] = (1 - MASK_SHARE) * picture[mask] + MASK_SHARE * np.array(OUTLINE)
    return outlined(picture, mask)


def outlined(picture: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The image (H, W, 3), with the outline of a mask (H, W) drawn into it."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, OUTLINE, 1)
    return picture


LARGEST_PX = 6
"""Side of the largest square."""


def render_points(
    points: NDArray, colors: NDArray[np.uint8], size: float, camera: Camera
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Render a point cloud.

    Args:
        points: (P, 3) world axes, mm. colors: (P, 3). size: width of a point, mm.
    Returns:
        (H, W, 3) image, black where there is no point, and (H, W) z of the visible points, mm, 0 where there is none.
    """
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    depth = np.zeros((camera.height, camera.width), np.float32)
    pixels, z = project(points.astype(np.float64), camera)
    inside = (z > 1e-3) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(-1)
    pixels, z, colors = pixels[inside], z[inside], colors[inside]
    if not len(z):
        return picture, depth
    far_to_near = np.argsort(-z, kind="stable")
    pixels, z, colors = pixels[far_to_near], z[far_to_near], colors[far_to_near]
    side = int(np.clip(np.ceil(camera.fy * size / np.median(z)), 1, LARGEST_PX))
    corner = np.floor(pixels - (side - 1) / 2).astype(int)
    # Far to near: for repeated indices NumPy keeps the last value.
    offsets = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)
    x, y = np.moveaxis(corner[:, None] + offsets, -1, 0)
    seen = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    at = y[seen], x[seen]
    picture[at] = np.broadcast_to(colors[:, None], (*x.shape, 3))[seen]
    depth[at] = np.broadcast_to(z[:, None], x.shape)[seen]
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
