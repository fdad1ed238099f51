"""Paths of cameras, and what they see, rendered to disk: color and depth, images side by side, and a video."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.types import Camera, Frame, to_uint8
from ..data.reading import read_text
from ..model.photometric import behind_smoke
from ..model.scene import RenderedScene
from ..system.atomic import whole_file
from .image_tools import colorize, label, tile, write_png
from .video import write_video

TimedCamera = tuple[float, Camera]

SWAY_SHARE = 0.12
"""Amplitude of the swaying camera, as a share of the distance to the tissue."""


def times_path(times: list[float], cameras: tuple[Camera, ...]) -> list[TimedCamera]:
    """The camera of the sequence at each of `times` in [0, 1]."""
    last = len(cameras) - 1
    return [(time, cameras[min(round(time * len(cameras)), last)]) for time in times]


def sway_path(times: list[float], cameras: tuple[Camera, ...], distance_mm: float) -> list[TimedCamera]:
    """The camera of the sequence, moved on a small circle, pointing at the point `distance_mm` straight ahead."""
    views = []
    for k, (time, camera) in enumerate(times_path(times, cameras)):
        angle = 2 * np.pi * k / max(len(times), 1)
        shift = SWAY_SHARE * distance_mm * np.array([np.sin(angle), 0.6 * (1 - np.cos(angle)), 0])
        views.append((time, _looking(camera, shift, distance_mm)))
    return views


def turned(camera: Camera, degrees: float, distance_mm: float) -> Camera:
    """`camera`, turned about a vertical axis through the point `distance_mm` ahead; above 0 it moves to its right."""
    angle = np.deg2rad(degrees)
    position = distance_mm * np.array([np.sin(angle), 0, 1 - np.cos(angle)])
    return _looking(camera, position, distance_mm)


def tissue_distance(frame: Frame, otherwise: float) -> float:
    """Median measured depth of the tissue of a frame, mm; `otherwise` where none was measured."""
    depths = frame.depth[frame.depth_valid & frame.tissue_mask]
    return float(np.median(depths)) if depths.size else otherwise


def _looking(camera: Camera, position: NDArray, distance: float) -> Camera:
    """`camera`, moved to a `position` in its own axes, pointing at (0, 0, distance) there."""
    forward = np.array([0, 0, distance]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation, matrix = np.stack([right, np.cross(forward, right), forward]), np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return replace(camera, world_to_camera=matrix @ camera.world_to_camera)


def read_path(file: Path, cameras: tuple[Camera, ...]) -> list[TimedCamera]:
    """Read a camera path: a JSON list of {"time": t in [0, 1], "world_to_camera": 4 x 4, mm, OpenCV axes}.

    A view without a matrix uses the camera of the sequence at that time. Intrinsics are those of the sequence.

    Raises:
        InputError: the file is missing, is not such a list, or a matrix is not a rigid transform.
    """
    text = read_text(file, "a camera path", "Correct the file.")
    try:
        views = [_view(entry, cameras) for entry in json.loads(text)]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        want = 'a JSON list of {"time": .., "world_to_camera": 4 x 4}'
        raise input_error(file, want, repr(error), "Correct the file.") from None
    if not views:
        raise input_error(file, "at least one view", "none", "Add one.")
    return views


def _view(entry: dict, cameras: tuple[Camera, ...]) -> TimedCamera:
    time = float(entry["time"])
    if not 0 <= time <= 1:
        raise ValueError(f"time {time} is not in [0, 1]")
    ((_, camera),) = times_path([time], cameras)
    if "world_to_camera" not in entry:
        return time, camera
    matrix = np.asarray(entry["world_to_camera"], np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("world_to_camera is not a 4 x 4 matrix of finite numbers")
    rotation = matrix[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    if not rigid or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise ValueError("world_to_camera is not a rotation and translation")
    return time, replace(camera, world_to_camera=matrix)


AT_A_TIME = 8
"""Number of views that a GPU renders in one call."""


def write_views(
    scene: RenderedScene,
    views: list[TimedCamera],
    out: Path,
    video: Path,
    frames: Sequence[Frame] | None = None,
    *,
    smoke: bool = True,
) -> None:
    """Write each view to `out/rgb/*.png`, `out/depth/*.npy` (mm, float32) and `out/side_by_side/*.png`, and a video.

    Args:
        frames: the input frames, one per view; without them the side-by-side shows color and depth only.
        video: path of the mp4 of the side-by-side images.
        smoke: show the smoke of each time, where the scene has any.
    """
    span, at_a_time = depth_span(scene), 1 if scene.device.type == "cpu" else AT_A_TIME

    def pictures() -> Iterator[list[NDArray[np.uint8]]]:
        for start in range(0, len(views), at_a_time):
            times, cameras = zip(*views[start : start + at_a_time], strict=True)
            for k, rendered in enumerate(scene.render_many(list(times), list(cameras)), start):
                rendered = behind_smoke(rendered, scene.smoke_at(views[k][0])) if smoke else rendered
                color, depth = to_uint8(rendered.color.cpu().numpy()), rendered.depth.cpu().numpy()
                write_png(out / "rgb" / f"{file_stem(k, frames)}.png", color)
                with whole_file(out / "depth" / f"{file_stem(k, frames)}.npy") as temporary:
                    np.save(temporary, depth)
                yield [label(color, "EndoPrior-GS"), label(colorize(depth, *span, depth > 0), "depth")]

    write_side_by_side(pictures(), out / "side_by_side", video, scene.frames_per_second, frames)


def write_side_by_side(
    pictures: Iterable[list[NDArray[np.uint8]]],
    out: Path,
    video: Path,
    frames_per_second: float,
    frames: Sequence[Frame] | None = None,
) -> None:
    """Write the pictures of each view beside each other as `out/*.png`, and all of them as a video.

    Args:
        pictures: (H, W, 3) images of one size for each view.
        frames: the input frames, one per view, which then stand at the left.
        video: path of the mp4.
    """

    def images() -> Iterator[NDArray[np.uint8]]:
        for k, parts in enumerate(pictures):
            beside = [label(frames[k].rgb_u8, "input"), *parts] if frames else parts
            image = tile(beside, len(beside))
            write_png(out / f"{file_stem(k, frames)}.png", image)
            yield image

    write_video(video, images(), frames_per_second)


def file_stem(k: int, frames: Sequence[Frame] | None) -> str:
    """Name of the files of view `k`: by its input frame, if there is one."""
    return f"{frames[k].index if frames else k:06d}"


def depth_span(scene: RenderedScene) -> tuple[float, float]:
    """Depth range of nearly all of the first frame, mm: one color scale for all images of a scene."""
    depth = scene.render(0.0).depth.cpu().numpy()
    covered = depth[depth > 0]
    low, high = np.percentile(covered, (2, 98)) if covered.size else (0.0, 1.0)
    return float(low), float(high)
