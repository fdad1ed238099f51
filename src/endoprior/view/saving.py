"""Screenshots and videos: the camera path of a video, encoding it, and storing files in a folder."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from ..core.checks import input_error
from ..core.types import Camera
from ..system.atomic import whole_file
from ..visualization.video import write_video
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


def mp4_bytes(pictures: Iterable[NDArray[np.uint8]], frames_per_second: float) -> bytes:
    """Images (H, W, 3) of one size as an H.264 video."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "video.mp4"
        write_video(file, pictures, frames_per_second)
        return file.read_bytes()


def keep(folder: Path, name: str, content: bytes) -> Path:
    """Write a file with the first free name `stem_N.suffix` in `folder`; never overwrite a file.

    Args:
        name: a plain file name.
    Returns:
        Path of the file.
    Raises:
        ValueError: `name` contains a folder, or has no suffix.
        InputError: `folder` is a link: in an untrusted run it could point anywhere.
    """
    if folder.is_symlink():
        raise input_error(folder, "a folder", "a link to one", "Remove the link.")
    if Path(name).name != name or not Path(name).suffix:
        raise ValueError(f"name must be a plain file name with a suffix, got {name!r}")
    stem, suffix = Path(name).stem, Path(name).suffix
    number = 1
    while (file := folder / f"{stem}_{number}{suffix}").exists():
        number += 1
    with whole_file(file) as temporary:
        temporary.write_bytes(content)
    return file
