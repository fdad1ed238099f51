"""A trained radiance field: the tissue at any time, from any viewpoint. It has no Gaussians."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from typing_extensions import override

from endoprior import Camera, Config
from endoprior.core.types import Fingerprints, RenderedView
from endoprior.model.rendered_scene import RenderedScene
from endoprior.model.scene_facts import SCENE_FORMAT, camera_arrays, scene_facts
from endoprior.render import Backend
from endoprior.system.arrays_file import save_arrays

from .field import RadianceField
from .presets import radiance_of
from .rays import all_rays

SAMPLES_AT_ONCE = {"cpu": 2**13, "cuda": 2**15}
"""Samples of rays in memory at a time. A CPU wants few, for its cache: EndoSurf takes 1.4 times as long with 2^15."""


@dataclass(frozen=True)
class RadianceScene(RenderedScene):
    """A radiance field and the cameras of the sequence that it was trained on."""

    field: RadianceField
    config: Config
    cameras: tuple[Camera, ...]
    frames_per_second: float
    lengths_are_relative: bool = False
    trained_on: Fingerprints | None = None

    @property
    @override
    def device(self) -> torch.device:
        return self.field.device

    @property
    @override
    def backend(self) -> str:
        return f"torch, {self.samples} samples per ray"

    @property
    def samples(self) -> int:
        """Of each ray."""
        radiance = radiance_of(self.config)
        return radiance.even_samples + radiance.more_samples

    @override
    def to(
        self, device: torch.device | str, *, backend: Backend | None = None, fp16_planes: bool = False
    ) -> RadianceScene:
        """`backend` and `fp16_planes` have no meaning here."""
        if torch.device(device) == self.device:
            return self
        return replace(self, field=deepcopy(self.field).to(device))

    @override
    def render(self, time: float, camera: Camera | None = None) -> RenderedView:
        """Rays go through the networks in groups, so that memory is bounded."""
        self.check_time(time)
        camera = camera or self.camera_at(time)
        rays, group = all_rays(camera, self.device), max(1, SAMPLES_AT_ONCE[self.device.type] // self.samples)
        views = [self.field.render(rays.part(k, k + group), time) for k in range(0, len(rays), group)]
        size = (camera.height, camera.width)
        parts = [torch.cat([getattr(view, name) for view in views]) for name in ("color", "depth", "alpha")]
        return RenderedView(parts[0].reshape(*size, 3), parts[1].reshape(size), parts[2].reshape(size))

    @override
    def save(self, path: str | Path) -> None:
        arrays = {f"field.{name}": value for name, value in self.field.state_dict().items()}
        arrays |= camera_arrays(self.cameras)
        save_arrays(Path(path), arrays, scene_facts(self), SCENE_FORMAT)
