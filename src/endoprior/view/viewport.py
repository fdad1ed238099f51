"""From a browser's canvas to the camera that draws for it, and from a click back to a pixel.

A browser draws with square pixels and the principal point in the middle of its canvas. The endoscope's picture is
therefore laid into a canvas so large that this holds, and what the browser draws itself falls on the right place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import quaternion_to_matrix
from ..core.types import Camera

LEAST_ASPECT, LARGEST_ASPECT = 0.25, 4.0
"""Canvases narrower or wider than this are treated as if they were not."""


@dataclass(frozen=True)
class Viewport:
    """A picture on a canvas; all in px of the picture."""

    camera: Camera
    """Draws the picture; its pixels are square."""
    width: int
    """Of the canvas."""
    height: int
    """Of the canvas."""
    left: int
    """Column of the canvas where the picture begins."""
    top: int
    """Row of the canvas where the picture begins."""

    @property
    def fov(self) -> float:
        """Vertical angle of the canvas, radians."""
        return float(2 * np.arctan(self.height / 2 / self.camera.fy))

    def paste(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(height, width, 3): the (H, W, 3) picture in its place, black around it."""
        if picture.shape[:2] == (self.height, self.width):
            return picture
        canvas = np.zeros((self.height, self.width, 3), np.uint8)
        canvas[self.top : self.top + len(picture), self.left : self.left + picture.shape[1]] = picture
        return canvas

    def pixel(self, screen: tuple[float, float]) -> tuple[float, float]:
        """Where in the picture a place on the canvas is, px; `screen` runs from (0, 0) upper left to (1, 1)."""
        return screen[0] * self.width - self.left, screen[1] * self.height - self.top

    def screen(self, pixel: tuple[float, float]) -> tuple[float, float]:
        """The inverse of `pixel`."""
        return (pixel[0] + self.left) / self.width, (pixel[1] + self.top) / self.height


def endoscope_viewport(camera: Camera, aspect: float, shrink: int = 1) -> Viewport:
    """The whole picture of `camera`, as large as it is stored (divided by `shrink`), on a canvas of this aspect."""
    camera = shrunk_camera(square_pixels(camera), shrink)
    half_width = max(camera.cx, camera.width - camera.cx)
    half_height = max(camera.cy, camera.height - camera.cy)
    height = max(half_height, half_width / aspect)
    # Even sizes: the middle of the canvas is between pixels, as the principal point of most cameras is.
    canvas = 2 * int(np.ceil(height * aspect)), 2 * int(np.ceil(height))
    left, top = round(canvas[0] / 2 - camera.cx), round(canvas[1] / 2 - camera.cy)
    return Viewport(camera, max(canvas[0], left + camera.width), max(canvas[1], top + camera.height), left, top)


def free_viewport(
    wxyz: NDArray, position: NDArray, fov: float, aspect: float, height: int, shrink: int = 1
) -> Viewport | None:
    """What a browser's own camera sees, on the whole canvas; None if what the browser sent is no camera.

    Args:
        wxyz: (4,) rotation from camera to world axes, OpenCV. position: (3,) world, mm. fov: vertical, radians.
        height: of the picture before it is divided by `shrink`, px.
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


def bounded_aspect(width: float, height: float) -> float:
    """width / height of a canvas, held in a sane range; 1 for a canvas of no size."""
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
