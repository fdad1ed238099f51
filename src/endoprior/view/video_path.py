"""Camera path of a saved video: all frames from one camera, or interpolation between saved views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ..core.types import Camera
from .viewport import riding

LEAST_STEPS = 24
"""Images between two saved views of the same frame."""


@dataclass(frozen=True)
class PathPoint:
    """A frame of the sequence and the camera that renders it."""

    frame: int
    camera: Camera


def follow_frames(cameras: tuple[Camera, ...], free: Camera | None, rides_from: int | None = None) -> list[PathPoint]:
    """Every frame, from the endoscope camera of that frame or, if given, from a `free` camera.

    Args:
        rides_from: the frame in which `free` is where it is; from there it moves with the endoscope. None: it stands.
    """
    if free is None:
        return [PathPoint(i, camera) for i, camera in enumerate(cameras)]
    if rides_from is None:
        return [PathPoint(i, free) for i in range(len(cameras))]
    return [PathPoint(i, riding(free, cameras[rides_from], camera)) for i, camera in enumerate(cameras)]


def interpolate(places: list[PathPoint]) -> list[PathPoint]:
    """A path through two or more views: every frame between them, linear positions, spherical rotations (slerp).

    Images have the size of the first view, whose height shows what the height of each view showed.
    """
    first, path = places[0].camera, []
    same_size = [PathPoint(place.frame, _between(first, place.camera, 1.0)) for place in places]
    for a, b in pairwise(same_size):
        steps = abs(b.frame - a.frame) or LEAST_STEPS
        shares = np.linspace(0, 1, steps, endpoint=False)
        frames = np.rint(a.frame + shares * (b.frame - a.frame)).astype(int)
        path += [PathPoint(int(i), _between(a.camera, b.camera, s)) for i, s in zip(frames, shares, strict=True)]
    return [*path, same_size[-1]]


def _between(a: Camera, b: Camera, share: float) -> Camera:
    """A camera with the image size of `a`, the share `share` of the way to `b`."""
    scale = a.height / b.height
    focal = (1 - share) * a.fy + share * b.fy * scale
    rotations = Rotation.from_matrix([a.world_to_camera[:3, :3], b.world_to_camera[:3, :3]])
    rotation = Slerp([0, 1], rotations)(share).as_matrix()
    center = (1 - share) * a.center + share * b.center
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return replace(a, fx=focal, fy=focal, cx=a.width / 2, cy=a.height / 2, world_to_camera=pose)
