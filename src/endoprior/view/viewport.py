"""Cameras of the viewer: a browser's canvas as a rendering camera, a click as a pixel, and the path of a video.

A browser renders with square pixels and the principal point in the center of its canvas. The endoscope image is
therefore placed in a larger canvas for which this holds, so that objects rendered by the browser are aligned with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from ..core.geometry import quaternion_to_matrix
from ..core.types import Camera

MIN_ASPECT, MAX_ASPECT = 0.25, 4.0
"""The aspect ratio of a canvas is clamped to this range."""
MIN_STEPS = 24
"""Images of a video between two saved views of the same frame."""


@dataclass(frozen=True)
class Viewport:
    """An image on a canvas; all lengths in px of the image."""

    camera: Camera
    """Renders the image; its pixels are square."""
    width: int
    """Of the canvas, as `height`."""
    height: int
    left: int = 0
    """First column of the image on the canvas; `top` is its first row."""
    top: int = 0

    @property
    def fov(self) -> float:
        """Vertical angle of the canvas, radians."""
        return float(2 * np.arctan(self.height / 2 / self.camera.fy))

    def paste(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(height, width, 3) canvas with the (H, W, 3) image in place, black around it."""
        canvas = np.zeros((self.height, self.width, 3), np.uint8)
        canvas[self.top : self.top + len(picture), self.left : self.left + picture.shape[1]] = picture
        return canvas

    def pixel(self, screen: tuple[float, float]) -> tuple[float, float]:
        """Pixel of the image at a canvas position: (0, 0) at the upper left, (1, 1) at the lower right; and back."""
        return screen[0] * self.width - self.left, screen[1] * self.height - self.top

    def screen(self, pixel: tuple[float, float]) -> tuple[float, float]:
        return (pixel[0] + self.left) / self.width, (pixel[1] + self.top) / self.height


def endoscope_viewport(camera: Camera, aspect: float, shrink: int = 1) -> Viewport:
    """The whole image of `camera` at its stored size divided by `shrink`, on a canvas of this aspect ratio."""
    camera = shrunk_camera(_square_pixels(camera), shrink)
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
    height = max(height // shrink, 2)
    width = max(round(height * aspect), 2)
    focal = height / 2 / np.tan(fov / 2)
    pose = _pose(quaternion_to_matrix(np.asarray(wxyz, np.float64)).T, position)
    return Viewport(Camera(width, height, focal, focal, width / 2, height / 2, pose), width, height)


def _pose(rotation: NDArray, center: NDArray) -> NDArray[np.float64]:
    """(4, 4) from world to camera axes: turned by (3, 3), seen from (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return pose


def bounded_aspect(width: float, height: float) -> float:
    """width / height of a canvas, clamped; 1 for an empty canvas."""
    if not (0 < width < float("inf") and 0 < height < float("inf")):
        return 1.0
    return min(max(width / height, MIN_ASPECT), MAX_ASPECT)


def _square_pixels(camera: Camera) -> Camera:
    """The same view with fx = fy."""
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


class PathPoint(NamedTuple):
    """A frame of the sequence and the camera that renders it."""

    frame: int
    camera: Camera


def follow_frames(
    cameras: tuple[Camera, ...], free: Camera | None = None, rides_from: int | None = None
) -> list[PathPoint]:
    """Every frame, from the endoscope camera of that frame or, if given, from a `free` camera.

    Args:
        rides_from: the frame in which `free` is where it is; from there it keeps its place beside the endoscope. None:
            it stands.
    """
    if free is not None and rides_from is not None:
        beside = free.world_to_camera @ np.linalg.inv(cameras[rides_from].world_to_camera)
        cameras = tuple(replace(free, world_to_camera=beside @ camera.world_to_camera) for camera in cameras)
    elif free is not None:
        cameras = (free,) * len(cameras)
    return [PathPoint(i, camera) for i, camera in enumerate(cameras)]


def interpolate(places: Sequence[PathPoint]) -> list[PathPoint]:
    """A path through two or more views: every frame between them, linear positions, spherical rotations (slerp).

    Images have the size of the first view, whose height shows what the height of each view showed.
    """
    first, path = places[0].camera, []
    same_size = [PathPoint(place.frame, _between(first, place.camera, 1.0)) for place in places]
    for a, b in pairwise(same_size):
        steps = abs(b.frame - a.frame) or MIN_STEPS
        for share in np.linspace(0, 1, steps, endpoint=False):
            frame = int(np.rint(a.frame + share * (b.frame - a.frame)))
            path.append(PathPoint(frame, _between(a.camera, b.camera, share)))
    return [*path, same_size[-1]]


def _between(a: Camera, b: Camera, share: float) -> Camera:
    """A camera with the image size of `a`, the share `share` of the way to `b`."""
    focal = (1 - share) * a.fy + share * b.fy * (a.height / b.height)
    rotations = Rotation.from_matrix([a.world_to_camera[:3, :3], b.world_to_camera[:3, :3]])
    pose = _pose(Slerp([0, 1], rotations)(share).as_matrix(), (1 - share) * a.center + share * b.center)
    return replace(a, fx=focal, fy=focal, cx=a.width / 2, cy=a.height / 2, world_to_camera=pose)
