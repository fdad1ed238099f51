"""Convert a browser's canvas to a rendering camera, and a click to a pixel.

A browser renders with square pixels and the principal point in the center of its canvas. The endoscope image is
therefore placed in a larger canvas for which this holds, so that objects rendered by the browser are aligned with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import quaternion_to_matrix
from ..core.types import Camera

LEAST_ASPECT, LARGEST_ASPECT = 0.25, 4.0
"""The aspect ratio of a canvas is clamped to this range."""


@dataclass(frozen=True)
class Viewport:
    """An image on a canvas; all lengths in px of the image."""

    camera: Camera
    """Renders the image; its pixels are square."""
    width: int
    """Width of the canvas."""
    height: int
    """Height of the canvas."""
    left: int
    """First column of the image on the canvas."""
    top: int
    """First row of the image on the canvas."""

    @property
    def fov(self) -> float:
        """Vertical angle of the canvas, radians."""
        return float(2 * np.arctan(self.height / 2 / self.camera.fy))

    def paste(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(height, width, 3) canvas with the (H, W, 3) image in place, black around it."""
        if picture.shape[:2] == (self.height, self.width):
            return picture
        canvas = np.zeros((self.height, self.width, 3), np.uint8)
        canvas[self.top : self.top + len(picture), self.left : self.left + picture.shape[1]] = picture
        return canvas

    def pixel(self, screen: tuple[float, float]) -> tuple[float, float]:
        """Pixel of the image at a canvas position; `screen` is (0, 0) at the upper left, (1, 1) at the lower right."""
        return screen[0] * self.width - self.left, screen[1] * self.height - self.top

    def screen(self, pixel: tuple[float, float]) -> tuple[float, float]:
        """The inverse of `pixel`."""
        return (pixel[0] + self.left) / self.width, (pixel[1] + self.top) / self.height


def endoscope_viewport(camera: Camera, aspect: float, shrink: int = 1) -> Viewport:
    """The whole image of `camera` at its stored size divided by `shrink`, on a canvas of this aspect ratio."""
    camera = shrunk_camera(square_pixels(camera), shrink)
    half_width = max(camera.cx, camera.width - camera.cx)
    half_height = max(camera.cy, camera.height - camera.cy)
    height = max(half_height, half_width / aspect)
    # Even sizes: the center of the canvas is between pixels, like the principal point of most cameras.
    canvas = 2 * int(np.ceil(height * aspect)), 2 * int(np.ceil(height))
    left, top = round(canvas[0] / 2 - camera.cx), round(canvas[1] / 2 - camera.cy)
    return Viewport(camera, max(canvas[0], left + camera.width), max(canvas[1], top + camera.height), left, top)


def free_viewport(
    wxyz: NDArray, position: NDArray, fov: float, aspect: float, height: int, shrink: int = 1
) -> Viewport | None:
    """The view of a browser's own camera on the whole canvas; None if the camera is invalid.

    Args:
        wxyz: (4,) rotation from camera to world axes, OpenCV. position: (3,) world, mm. fov: vertical, radians.
        height: image height before division by `shrink`, px.
    """
    finite = np.isfinite([*wxyz, *position, fov]).all()
    if not finite or not 0.01 < fov < 3.1 or np.linalg.norm(wxyz) < 1e-6:
        return None
    rotation = quaternion_to_matrix(np.asarray(wxyz, np.float64)).T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    height = max(height // shrink, 2)
    width = max(round(height * aspect), 2)
    focal = height / 2 / np.tan(fov / 2)
    return Viewport(Camera(width, height, focal, focal, width / 2, height / 2, pose), width, height, 0, 0)


def riding(camera: Camera, before: Camera, now: Camera) -> Camera:
    """`camera` moved as the endoscope moves from `before` to `now`: it stays where it was beside the endoscope."""
    pose = camera.world_to_camera @ np.linalg.inv(before.world_to_camera) @ now.world_to_camera
    return replace(camera, world_to_camera=pose)


def bounded_aspect(width: float, height: float) -> float:
    """width / height of a canvas, clamped; 1 for an empty canvas."""
    if not (0 < width < float("inf") and 0 < height < float("inf")):
        return 1.0
    return min(max(width / height, LEAST_ASPECT), LARGEST_ASPECT)


def square_pixels(camera: Camera) -> Camera:
    """The same view with fx = fy; the camera itself if they are equal."""
    if camera.fx == camera.fy:
        return camera
    stretch = camera.fy / camera.fx
    return replace(camera, width=max(round(camera.width * stretch), 1), fx=camera.fy, cx=camera.cx * stretch)


def shrunk_camera(camera: Camera, shrink: int) -> Camera:
    """The same view with 1 / `shrink` of the pixels each way."""
    if shrink == 1:
        return camera
    lengths = {name: getattr(camera, name) / shrink for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, width=max(camera.width // shrink, 1), height=max(camera.height // shrink, 1), **lengths)
