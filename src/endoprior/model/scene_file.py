"""Reads scenes from files, which may be untrusted: everything is checked before it is used."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from torch import Tensor

from ..core.checks import InputError, check_range, input_error
from ..core.config import Config
from ..core.config_io import from_dict
from ..core.geometry import FARTHEST_MM
from ..core.ranges import Checked, Range
from ..core.shell import command
from ..core.types import Camera
from ..system.arrays_file import ArraySpec, load_arrays, part, rejecting
from . import windowed_scene
from .deformation import HexPlaneField
from .gaussians import Gaussians
from .scene import Scene
from .schema import model_schema
from .single_scene import FORMAT, SingleScene, camera_arrays
from .windowed_scene import Span, WindowedScene, window_file

LARGEST_SIDE = 2**16
"""Largest width or height of an image, px."""
LARGEST_IMAGE = 2**26
"""Largest number of pixels of an image: 8192 x 8192."""
MOST_GAUSSIANS, MOST_FRAMES = 10_000_000, 1_000_000
NEXT_STEP = "Train the scene again."
CAMERAS = {
    "camera.intrinsics": ArraySpec("float64", ("T", 4)),
    "camera.world_to_camera": ArraySpec("float64", ("T", 4, 4)),
}
LARGEST_DEVIATION = 5e-3
"""Largest entry of R R^T - I that still passes for a rotation; readers accept 1e-3 of R^T R."""


def load_scene(path: str | Path) -> Scene:
    """Read a scene from a run folder or from the path of `scene.safetensors` itself.

    Raises:
        InputError: there is no such file, or it is not a scene this version can read.
    """
    path = Path(path)
    file = path / "scene.safetensors" if os.path.isdir(path) else path
    if not os.path.isfile(file):  # of a name too long for the system pathlib would raise
        raise input_error(file, "a trained scene", "none", f"`{command('train', 'DATA', path)}`.")
    arrays, about = load_arrays(file, {FORMAT: scene_schema, windowed_scene.FORMAT: index_schema}, NEXT_STEP)
    with rejecting(file, "a scene", NEXT_STEP):
        facts = from_dict(SceneFacts, {name: value for name, value in about.items() if name != "format"}, "about")
        _check_cameras(arrays)
        if about["format"] == windowed_scene.FORMAT:
            return _windowed(arrays, facts, file)
        check_values(arrays)
        return _single(arrays, facts)


@dataclass(frozen=True)
class SceneFacts(Checked):
    """Metadata of a scene's file."""

    config: Config
    width: Annotated[int, Range(1, LARGEST_SIDE)]
    height: Annotated[int, Range(1, LARGEST_SIDE)]
    frames_per_second: Annotated[float, Range(1e-3, 1e6)]
    lengths_are_relative: bool = False
    trained_from: Annotated[float, Range(0, 1)] = 0.0
    trained_until: Annotated[float, Range(0, 1)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("width times height", self.width * self.height, 1, LARGEST_IMAGE)
        check_range("trained_until", self.trained_until, self.trained_from, 1)


def scene_schema(about: dict[str, Any]) -> dict[str, ArraySpec]:
    """The arrays of a scene's file of this description; `N` Gaussians, `T` frames."""
    per_gaussian = {name: ArraySpec("float32", ("N",)) for name in ("prior_score", "num_valid")}
    return model_schema(from_dict(Config, about["config"])) | per_gaussian | CAMERAS


def index_schema(about: dict[str, Any]) -> dict[str, ArraySpec]:
    """The arrays of a list of `K` windows."""
    return CAMERAS | {"windows": ArraySpec("int64", ("K", 3))}


def check_values(arrays: Mapping[str, Tensor]) -> None:
    """Reject arrays of a scene, finite and of the right shapes, that no scene can have.

    Raises:
        InputError: naming the array.
    """
    num, quats = len(arrays["gaussians.means"]), arrays["gaussians.quats"]
    _demand(
        ("gaussians", num <= MOST_GAUSSIANS, f"at most {MOST_GAUSSIANS:,} Gaussians"),
        ("gaussians.quats", bool((quats.abs().amax(1) >= 1e-12).all()) if num else True, "no quaternion of length 0"),
        ("num_valid", bool((arrays["num_valid"] >= 0).all()), "counts"),
    )


def check_cameras(cameras: tuple[Camera, ...]) -> None:
    """Reject cameras with which a saved scene could not be loaded.

    Raises:
        InputError: naming what is wrong with them.
    """
    first = cameras[0]
    _demand(
        ("width and height", max(first.width, first.height) <= LARGEST_SIDE, f"at most {LARGEST_SIDE:,} px"),
        ("width times height", first.width * first.height <= LARGEST_IMAGE, f"at most {LARGEST_IMAGE:,} px"),
    )
    _check_cameras(camera_arrays(cameras))


def _check_cameras(arrays: Mapping[str, Tensor]) -> None:
    intrinsics, poses = (arrays[name].numpy() for name in CAMERAS)
    deviation = poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1) - np.eye(3)
    rigid = (np.abs(deviation) <= LARGEST_DEVIATION).all((1, 2)) & (np.linalg.det(poses[:, :3, :3]) > 0)
    rigid &= (poses[:, 3] == (0, 0, 0, 1)).all(1) & (np.abs(poses[:, :3, 3]) <= FARTHEST_MM).all(1)
    focal = (intrinsics[:, :2] >= 1e-3) & (intrinsics[:, :2] <= 1e7)
    _demand(
        ("camera.intrinsics", 1 <= len(intrinsics) <= MOST_FRAMES, f"1 to {MOST_FRAMES:,} frames"),
        ("camera.intrinsics", focal.all(), "focal lengths of 0.001 to 1e7 px"),
        ("camera.intrinsics", (np.abs(intrinsics[:, 2:]) <= 1e7).all(), "principal points within 1e7 px"),
        ("camera.world_to_camera", rigid.all(), f"rigid transforms within {FARTHEST_MM:g} mm"),
    )


def _demand(*facts: tuple[str, Any, str]) -> None:
    """Raise InputError at the first (name, whether it is so, what was expected) that is not so."""
    for name, so, expected in facts:
        if not so:
            raise InputError(f"expected {expected} in {name}; got something else.")


def _cameras(arrays: Mapping[str, Tensor], facts: SceneFacts) -> tuple[Camera, ...]:
    intrinsics, poses = arrays["camera.intrinsics"].numpy(), arrays["camera.world_to_camera"].numpy()
    return tuple(
        Camera(facts.width, facts.height, *map(float, k), pose) for k, pose in zip(intrinsics, poses, strict=True)
    )


def _single(arrays: dict[str, Tensor], facts: SceneFacts) -> SingleScene:
    field = None
    if facts.config.deformation.kind == "hexplane":
        field = HexPlaneField.from_state_arrays(part(arrays, "field."), facts.config.deformation)
    return SingleScene(
        Gaussians(part(arrays, "gaussians.")),
        field,
        facts.config,
        _cameras(arrays, facts),
        facts.frames_per_second,
        arrays["prior_score"],
        arrays["num_valid"],
        facts.lengths_are_relative,
        facts.trained_from,
        facts.trained_until,
    )


def _windowed(arrays: dict[str, Tensor], facts: SceneFacts, file: Path) -> WindowedScene:
    cameras, spans = _cameras(arrays, facts), tuple(Span(*row) for row in arrays["windows"].tolist())
    _check_spans(spans, len(cameras))

    def read(k: int) -> SingleScene:
        window, span = window_file(file, k), spans[k]
        scene, length = load_scene(window), span.stop - span.start
        if isinstance(scene, SingleScene) and (len(scene.cameras), len(scene)) == (length, span.num_gaussians):
            return scene
        got = f"{len(scene.cameras)} frames and {len(scene):,} Gaussians"
        raise input_error(
            window, f"{length} frames and {span.num_gaussians:,} Gaussians, as {file} says", got, NEXT_STEP
        )

    return WindowedScene(facts.config, cameras, facts.frames_per_second, spans, read, facts.lengths_are_relative)


def _check_spans(spans: tuple[Span, ...], num_frames: int) -> None:
    """Reject windows that do not cover the sequence one after the other."""
    ends = [(0, 0), *((span.start, span.stop) for span in spans)]
    ordered = all(a < b <= stop < d for (a, stop), (b, d) in pairwise(ends[1:]))
    apart = all(first.stop <= third.start for first, third in zip(spans, spans[2:], strict=False))
    _demand(
        ("windows", bool(spans) and ends[1][0] == 0 and ends[-1][1] == num_frames, f"frames 0 to {num_frames}"),
        ("windows", ordered and apart and all(a < b for a, b in ends[1:]), "windows in order"),
        ("windows", all(0 <= span.num_gaussians <= MOST_GAUSSIANS for span in spans), "counts of Gaussians"),
    )
