"""Reads radiance fields from files, which may be untrusted: everything is checked before it is used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from ..core.checks import InputError
from ..core.config import Config
from ..core.config_io import from_dict
from ..core.types import Camera
from ..model.scene_file import CAMERAS, NEXT_STEP, SceneFacts, check_cameras
from ..system.arrays_file import ArraySpec, load_arrays, part, rejecting
from .endonerf import EndoNeRF
from .endosurf import EndoSurf
from .field import RadianceField
from .scene import FORMAT, RadianceScene

FIELDS: dict[str, type[RadianceField]] = {field.name: field for field in (EndoNeRF, EndoSurf)}
"""Every radiance field by name."""


@dataclass(frozen=True)
class RadianceFacts(SceneFacts):
    """Metadata of the file of a radiance field."""

    field: Literal["endonerf", "endosurf"] = "endonerf"


def radiance_schema(about: dict[str, Any]) -> dict[str, ArraySpec]:
    """The arrays of a file of this description; `T` frames."""
    name, cfg = about["field"], from_dict(Config, about["config"])
    if name not in FIELDS:
        raise InputError(f"expected field {' or '.join(FIELDS)}; got {name!r:.80}.")
    return {f"field.{each}": spec for each, spec in FIELDS[name].schema(cfg.radiance).items()} | CAMERAS


def radiance_scene(arrays: Mapping[str, Tensor], about: Mapping[str, Any]) -> RadianceScene:
    """The scene of a file whose arrays match `radiance_schema` and are finite.

    Raises:
        InputError: a value that no trained field has.
    """
    facts = from_dict(RadianceFacts, {name: value for name, value in about.items() if name != "format"}, "about")
    cameras = tuple(
        Camera(facts.width, facts.height, *map(float, k), pose)
        for k, pose in zip(*(arrays[name].numpy() for name in CAMERAS), strict=True)
    )
    if not cameras:
        raise InputError("expected 1 frame or more in camera.intrinsics; got none.")
    check_cameras(cameras)
    field = FIELDS[facts.field](facts.config.radiance)
    field.load_state_dict(part(arrays, "field."))
    if wrong := field.wrong_values():
        raise InputError(f"expected {wrong}; got something else.")
    return RadianceScene(field, facts.config, cameras, facts.frames_per_second, facts.lengths_are_relative)


def load_radiance_scene(path: Path) -> RadianceScene:
    """Read a scene from its file.

    Raises:
        InputError: it is not a radiance field that this version can read.
    """
    arrays, about = load_arrays(path, {FORMAT: radiance_schema}, NEXT_STEP)
    with rejecting(path, "a radiance field", NEXT_STEP):
        return radiance_scene(arrays, about)
