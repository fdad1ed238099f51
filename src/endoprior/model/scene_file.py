"""Reads scenes from files, which may be untrusted: everything is checked before it is used."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ..compute.parallel_kernels import demand_unforked
from ..core.checks import InputError, input_error
from ..core.config import OWN, Config
from ..core.config_io import from_dict
from ..core.geometry import FARTHEST_MM
from ..core.shell import command
from ..core.types import Camera
from ..system.arrays_file import ArraySpec, load_arrays, rejecting
from . import windowed_scene
from .method import config_from, method_of
from .photometric import GRID
from .scene import RenderedScene, SingleScene
from .scene_facts import MAX_IMAGE, MAX_SIDE, MAX_STORED_GAUSSIANS, SCENE_FORMAT, SceneFacts, camera_arrays, demand
from .uncertainty import CELLS
from .windowed_scene import Span, WindowedScene, window_file

MAX_FRAMES = 1_000_000
NEXT_STEP = "Train the scene again."
CAMERAS = {
    "camera.intrinsics": ArraySpec("float64", ("T", 4)),
    "camera.world_to_camera": ArraySpec("float64", ("T", 4, 4)),
}
MAX_DEVIATION = 5e-3
"""Largest entry of R R^T - I that still passes for a rotation; readers accept 1e-3 of R^T R."""


def load_scene(path: str | Path) -> RenderedScene:
    """Read a scene from a run folder or from the path of `scene.safetensors` itself.

    Raises:
        InputError: there is no such file, or it is not a scene this version can read.
        RuntimeError: this process is a fork of one that has rendered or trained.

    Example:
        >>> import endoprior
        >>> scene = endoprior.load_scene("RUN")
        >>> scene.at(time=0.5).means.shape[1], len(scene.cameras)
        (3, 10)
    """
    demand_unforked()
    path = Path(path)
    file = path / "scene.safetensors" if os.path.isdir(path) else path
    if not os.path.isfile(file):  # of a name too long for the system pathlib would raise
        stopped = os.path.isfile(path / "config.json")  # of a run, written first
        finish = command("train", "--resume", path) if stopped else command("train", "DATA", path)
        raise input_error(file, "a trained scene", "an unfinished run" if stopped else "none", f"`{finish}`.")
    schemas = {SCENE_FORMAT: scene_schema, windowed_scene.WINDOWS_FORMAT: index_schema}
    arrays, about = load_arrays(file, schemas, NEXT_STEP)
    with rejecting(file, "a scene", NEXT_STEP):
        known = {name: value for name, value in about.items() if name != "format"}
        facts = from_dict(SceneFacts, known | {"config": _config(about)}, "about")
        _check_cameras(arrays)
        if about["format"] == windowed_scene.WINDOWS_FORMAT:
            return _windowed(arrays, facts, file)
        return method_of(facts.config).scene(arrays, _cameras(arrays, facts), facts)


def scene_schema(about: dict[str, Any]) -> dict[str, ArraySpec]:
    """The arrays of a scene's file of this description; `T` frames."""
    cfg = _config(about)
    smoke = {"smoke": ArraySpec("float32", ("T", *GRID, 2))} if about.get("smoke") else {}
    tissue = {"tissue": ArraySpec("uint8", ("T", *CELLS))} if about.get("tissue") else {}
    return method_of(cfg).schema(cfg) | CAMERAS | smoke | tissue


def _config(about: dict[str, Any]) -> Config:
    """What a scene was trained with; one of both eyes from before there was gloss is as one of the left eye."""
    cfg = config_from(about["config"])
    of_windows, deformation = about["format"] == windowed_scene.WINDOWS_FORMAT, cfg.deformation
    if cfg.method == OWN and deformation.kind == "basis" and not deformation.basis.num_frames and not of_windows:
        got = "radial basis functions, of an earlier version"
        raise InputError(f"config.deformation.basis: expected splines over time; got {got}.")
    of_one = about["format"] == SCENE_FORMAT and not about.get("baseline_mm")
    return replace(cfg, data=replace(cfg.data, eyes="left")) if of_one else cfg


def index_schema(_about: dict[str, Any]) -> dict[str, ArraySpec]:
    """The arrays of a list of `K` windows."""
    return CAMERAS | {"windows": ArraySpec("int64", ("K", 3))}


def check_cameras(cameras: tuple[Camera, ...]) -> None:
    """Reject cameras with which a saved scene could not be loaded.

    Raises:
        InputError: naming what is wrong with them.
    """
    first = cameras[0]
    demand(
        ("width and height", max(first.width, first.height) <= MAX_SIDE, f"at most {MAX_SIDE:,} px"),
        ("width times height", first.width * first.height <= MAX_IMAGE, f"at most {MAX_IMAGE:,} px"),
    )
    _check_cameras(camera_arrays(cameras))


def _check_cameras(arrays: Mapping[str, Tensor]) -> None:
    intrinsics, poses = (arrays[name].numpy() for name in CAMERAS)
    deviation = poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1) - np.eye(3)
    rigid = (np.abs(deviation) <= MAX_DEVIATION).all((1, 2)) & (np.linalg.det(poses[:, :3, :3]) > 0)
    rigid &= (poses[:, 3] == (0, 0, 0, 1)).all(1) & (np.abs(poses[:, :3, 3]) <= FARTHEST_MM).all(1)
    focal = (intrinsics[:, :2] >= 1e-3) & (intrinsics[:, :2] <= 1e7)
    demand(
        ("camera.intrinsics", 1 <= len(intrinsics) <= MAX_FRAMES, f"1 to {MAX_FRAMES:,} frames"),
        ("camera.intrinsics", focal.all(), "focal lengths of 0.001 to 1e7 px"),
        ("camera.intrinsics", (np.abs(intrinsics[:, 2:]) <= 1e7).all(), "principal points within 1e7 px"),
        ("camera.world_to_camera", rigid.all(), f"rigid transforms within {FARTHEST_MM:g} mm"),
    )


def _cameras(arrays: Mapping[str, Tensor], facts: SceneFacts) -> tuple[Camera, ...]:
    intrinsics, poses = arrays["camera.intrinsics"].numpy(), arrays["camera.world_to_camera"].numpy()
    return tuple(
        Camera(facts.width, facts.height, float(fx), float(fy), float(cx), float(cy), pose)
        for (fx, fy, cx, cy), pose in zip(intrinsics, poses, strict=True)
    )


def _windowed(arrays: dict[str, Tensor], facts: SceneFacts, file: Path) -> WindowedScene:
    cameras, spans = _cameras(arrays, facts), tuple(Span(*row) for row in arrays["windows"].tolist())
    _check_spans(spans, len(cameras))

    def read(k: int) -> SingleScene:
        window, span = window_file(file, k), spans[k]
        scene, length = load_scene(window), span.stop - span.start
        if isinstance(scene, SingleScene) and (len(scene.cameras), len(scene)) == (length, span.num_gaussians):
            return scene
        count = f"{len(scene):,}" if isinstance(scene, SingleScene) else "no"
        got = f"{len(scene.cameras)} frames and {count} Gaussians"
        raise input_error(
            window, f"{length} frames and {span.num_gaussians:,} Gaussians, as {file} says", got, NEXT_STEP
        )

    return WindowedScene(
        config=facts.config,
        cameras=cameras,
        frames_per_second=facts.frames_per_second,
        spans=spans,
        read=read,
        lengths_are_relative=facts.lengths_are_relative,
        trained_on=facts.trained_on,
    )


def _check_spans(spans: tuple[Span, ...], num_frames: int) -> None:
    """Reject windows that do not cover the sequence one after the other."""
    ends = [(0, 0), *((span.start, span.stop) for span in spans)]
    ordered = all(a < b <= stop < d for (a, stop), (b, d) in pairwise(ends[1:]))
    apart = all(first.stop <= third.start for first, third in zip(spans, spans[2:], strict=False))
    demand(
        ("windows", bool(spans) and ends[1][0] == 0 and ends[-1][1] == num_frames, f"frames 0 to {num_frames}"),
        ("windows", ordered and apart and all(a < b for a, b in ends[1:]), "windows in order"),
        ("windows", all(0 <= span.num_gaussians <= MAX_STORED_GAUSSIANS for span in spans), "counts of Gaussians"),
    )
