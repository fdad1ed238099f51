"""The path a film follows: every frame from where one looks now, or through places that were kept."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ..core.types import Camera

LEAST_STEPS = 24
"""Pictures between two kept places whose frames are the same."""


@dataclass(frozen=True)
class Place:
    """A moment and where it was looked at from."""

    frame: int
    camera: Camera


def sweep(cameras: tuple[Camera, ...], standing: Camera | None) -> list[Place]:
    """Every frame, from the endoscope's camera of that frame or, if given, from `standing`."""
    return [Place(i, standing or camera) for i, camera in enumerate(cameras)]


def through(places: list[Place]) -> list[Place]:
    """Pictures along two or more places: frames one by one, positions along lines, rotations along great circles."""
    path = []
    for a, b in pairwise(places):
        steps = abs(b.frame - a.frame) or LEAST_STEPS
        shares = np.linspace(0, 1, steps, endpoint=False)
        frames = np.rint(a.frame + shares * (b.frame - a.frame)).astype(int)
        path += [Place(int(i), _between(a.camera, b.camera, s)) for i, s in zip(frames, shares, strict=True)]
    last = places[-1]
    return [*path, Place(last.frame, _between(places[0].camera, last.camera, 1.0))]


def _between(a: Camera, b: Camera, share: float) -> Camera:
    """A camera of the picture size of `a`, part of the way to `b`."""
    scale = a.height / b.height
    focal = (1 - share) * a.fy + share * b.fy * scale
    rotations = Rotation.from_matrix([a.world_to_camera[:3, :3], b.world_to_camera[:3, :3]])
    rotation = Slerp([0, 1], rotations)(share).as_matrix()
    center = (1 - share) * a.center + share * b.center
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return replace(a, fx=focal, fy=focal, cx=a.width / 2, cy=a.height / 2, world_to_camera=pose)
