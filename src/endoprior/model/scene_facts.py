"""What the file of every scene says beside its arrays, and the arrays of its cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from ..core.checks import InputError, check_range
from ..core.config import Config
from ..core.config_io import to_dict
from ..core.ranges import Checked, Range
from ..core.types import Camera, Fingerprints
from .rendered_scene import RenderedScene

SCENE_FORMAT = "endoprior-scene-1"
"""Name and version of the file format, in the file's metadata."""
MAX_SIDE = 2**16
"""Largest width or height of an image, px."""
MAX_IMAGE = 2**26
"""Largest number of pixels of an image: 8192 x 8192."""
MAX_STORED_GAUSSIANS = 10_000_000


@dataclass(frozen=True)
class SceneFacts(Checked):
    """Metadata of a scene's file."""

    config: Config
    width: Annotated[int, Range(1, MAX_SIDE)]
    height: Annotated[int, Range(1, MAX_SIDE)]
    frames_per_second: Annotated[float, Range(1e-3, 1e6)]
    lengths_are_relative: bool = False
    trained_from: Annotated[float, Range(0, 1)] = 0.0
    trained_until: Annotated[float, Range(0, 1)] = 1.0
    baseline_mm: Annotated[float, Range(0, 1e6)] = 0.0
    smoke: bool = False
    tissue: bool = False
    depth_noise: Annotated[float, Range(0, 10)] = 0.0
    trained_on: Fingerprints | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("width times height", self.width * self.height, 1, MAX_IMAGE)
        check_range("trained_until", self.trained_until, self.trained_from, 1)


def scene_facts(scene: RenderedScene) -> dict[str, Any]:
    """What the metadata of every scene's file say."""
    first = scene.cameras[0]
    known = {} if scene.trained_on is None else {"trained_on": to_dict(scene.trained_on)}
    return known | {
        "config": to_dict(scene.config),
        "frames_per_second": scene.frames_per_second,
        "lengths_are_relative": scene.lengths_are_relative,
        "width": first.width,
        "height": first.height,
    }


def camera_arrays(cameras: tuple[Camera, ...]) -> dict[str, Tensor]:
    """By their names in a file: (T, 4) fx, fy, cx, cy in px, and (T, 4, 4) world-to-camera; float64."""
    intrinsics = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras])
    poses = np.stack([c.world_to_camera for c in cameras])
    return {"camera.intrinsics": torch.from_numpy(intrinsics), "camera.world_to_camera": torch.from_numpy(poses)}


def demand(*facts: tuple[str, Any, str]) -> None:
    """Raise InputError at the first (name, whether it is so, what was expected) that is not so."""
    for name, so, expected in facts:
        if not so:
            raise InputError(f"expected {expected} in {name}; got something else.")
