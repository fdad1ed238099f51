"""What the frames of a scene show: depth images, cameras, a rendered video; and the scene itself as one file."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..core.geometry import camera_to_world
from ..core.shell import command
from ..core.types import Camera, to_uint8
from ..data.images import encode_png
from ..model.scene import Scene
from ..model.surface import render_surface
from ..system.atomic import whole_folder, write_json, write_text
from ..visualization.video import write_video
from .axes import points_in_axes
from .formats import TIME_STEP_OPTIONS, Axes, ExportFormat, ExportOptions, Progress
from .time_steps import TimeStep, frame_indices, selected_time_steps

MM_PER_M = 1000.0
PNG_STEPS_PER_MM = 100
"""Depth in a PNG is counted in 0.01 mm, so 65535 is 655.35 mm."""


def depth(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """Expected depth from the frame's own camera, as .png and as float32 .npy in mm; 0 where there is no surface."""
    found = render_surface(scene, step.time, step.camera(scene), options.min_alpha).depth
    stored = io.BytesIO()
    np.save(stored, found)
    return {".png": depth_png(found), ".npy": stored.getvalue()}


def depth_png(depth: NDArray[np.float32]) -> bytes:
    """A 16-bit gray PNG of (H, W) depth, mm; what is deeper than 655.35 mm does not fit and becomes 0, missing."""
    steps = np.rint(depth * np.float32(PNG_STEPS_PER_MM))
    return encode_png(np.where(steps <= 65535, steps, 0).astype(np.uint16))


def write_cameras(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the `cameras.json` of 3DGS (Kerbl et al. 2023), which viewers of Gaussians read: a camera per time step.

    It is a format of its own, because SuperSplat takes a folder of PLY files for a sequence only if nothing else is in
    it.
    """
    steps = selected_time_steps(scene, options)
    write_json(out, [_entry(k, step.name, step.camera(scene), options.axes) for k, step in enumerate(steps)])
    progress(1, 1)


def _entry(number: int, name: str, camera: Camera, axes: Axes) -> dict[str, Any]:
    """Position (mm) and camera-to-world rotation of right, down, forward; px. 3DGS itself has no cx and cy."""
    pose = {
        "position": points_in_axes(camera.center, axes).tolist(),
        "rotation": points_in_axes(camera.world_to_camera[:3, :3], axes).T.tolist(),
    }
    about = {"id": number, "img_name": name, "width": camera.width, "height": camera.height}
    return about | pose | {name: getattr(camera, name) for name in ("fy", "fx", "cx", "cy")}


def write_tum(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the path of the camera as the TUM RGB-D benchmark has it: `time x y z qx qy qz qw`, s and m."""
    steps = selected_time_steps(scene, options)
    seconds = [step.time * len(scene.cameras) / scene.frames_per_second for step in steps]
    poses = _poses(scene, steps)
    rows = np.column_stack([seconds, poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat()])
    write_text(out, f"# time x y z qx qy qz qw: {_about(scene)}\n{_lines(rows)}")
    progress(1, 1)


def write_kitti(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the path of the camera as KITTI's odometry benchmark has it: the 3x4 pose row by row in each line, m."""
    poses = _poses(scene, selected_time_steps(scene, options))
    write_text(out, _lines(poses.reshape(-1, 12)))  # its readers take no comments
    progress(1, 1)


def path_note(scene: Scene, out: Path, _options: ExportOptions) -> str:
    """What the numbers are, and the command that reads them."""
    return f"{_about(scene)}. To read it: `{command('poses', 'DATA', '--poses', out)}`"


def _about(scene: Scene) -> str:
    unit = "1000 units of an assumed scale" if scene.lengths_are_relative else "m"
    return f"camera to world, OpenCV axes, {unit}, of the frames after rectification"


def _poses(scene: Scene, steps: list[TimeStep]) -> NDArray[np.float64]:
    """(T, 3, 4) camera-to-world, m."""
    poses = camera_to_world(step.camera(scene) for step in steps)[:, :3]
    poses[:, :, 3] /= MM_PER_M
    return poses


def _lines(rows: NDArray[np.float64]) -> str:
    return "".join(" ".join(f"{value:.9g}" for value in row) + "\n" for row in rows + 0.0)  # no -0


def write_rendered(scene: Scene, out: Path, options: ExportOptions, progress: Progress) -> None:
    """Write the frames of a split, rendered from their cameras, as H.264 mp4 at the sequence's frame rate."""
    indices = frame_indices(len(scene.cameras), options.split, scene.config.data)

    def images() -> Iterator[NDArray[np.uint8]]:
        for k, i in enumerate(indices):
            yield to_uint8(scene.render(scene.frame_time(i), scene.cameras[i]).color.numpy())
            progress(k + 1, len(indices))

    write_video(out, images(), scene.frames_per_second)


def write_scene(scene: Scene, out: Path, _options: ExportOptions, progress: Progress) -> None:
    """Write one safetensors file, of equal bytes to the run's own if this version wrote that; see docs/format.md.

    For a scene of several windows, whose files stand side by side, a folder `out` with those of a run folder.
    """
    if len(scene.windows) == 1:
        scene.save(out)
    else:
        with whole_folder(out) as folder:
            scene.save(folder / "scene.safetensors")
    progress(1, 1)


DEPTH = ExportFormat(
    suffixes=(".png", ".npy"),
    options=("times", "split", "min_alpha"),
    files=depth,
    index_facts={"png_unit_mm": 1 / PNG_STEPS_PER_MM, "npy_unit_mm": 1.0, "missing": 0},
    holds="depth",
)
CAMERAS = ExportFormat(suffixes=(".json",), options=TIME_STEP_OPTIONS, write=write_cameras, holds="cameras")
TUM = ExportFormat((".tum",), ("times", "split"), write=write_tum, holds="the path of the camera", note=path_note)
KITTI = ExportFormat((".kitti",), ("times", "split"), write=write_kitti, holds="the path of the camera", note=path_note)
VIDEO = ExportFormat(suffixes=(".mp4",), options=("split",), write=write_rendered, holds="a video")
SCENE = ExportFormat(
    suffixes=(".safetensors",), options=(), write=write_scene, holds="the whole scene, motion included"
)
