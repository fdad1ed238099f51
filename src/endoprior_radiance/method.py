"""Radiance fields, EndoNeRF and EndoSurf: slow on a CPU."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor
from typing_extensions import override

from endoprior import Camera, Config, FrameSequence, InputError
from endoprior.model.scene_facts import SceneFacts
from endoprior.system.arrays_file import ArraySpec, part
from endoprior.training.method import Method

from . import presets
from .endonerf import EndoNeRF
from .endosurf import EndoSurf
from .field import RadianceField
from .presets import RadianceFieldConfig, radiance_of
from .scene import RadianceScene
from .trainer import RadianceTrainer


class RadianceMethod(Method):
    """See `Method`."""

    has_gaussians = False
    config_type = RadianceFieldConfig
    only: Mapping[str, Any] = {"data.eyes": "left", "init.motion": "rest", "fit_to_clip": False}

    def __init__(self, kind: type[RadianceField], config: Callable[[], Config]) -> None:
        self.kind, self._config = kind, config

    def config(self) -> Config:
        """What its preset starts from."""
        return self._config()

    @override
    def trainer(self, sequence: FrameSequence, cfg: Config) -> RadianceTrainer:
        return RadianceTrainer(sequence, cfg, self.kind)

    @override
    def schema(self, cfg: Config) -> dict[str, ArraySpec]:
        return {f"field.{name}": spec for name, spec in self.kind.schema(radiance_of(cfg)).items()}

    @override
    def scene(self, arrays: Mapping[str, Tensor], cameras: tuple[Camera, ...], facts: SceneFacts) -> RadianceScene:
        field = self.kind(radiance_of(facts.config))
        field.load_state_dict(part(arrays, "field."))
        if wrong := field.wrong_values():
            raise InputError(f"expected {wrong}; got something else.")
        return RadianceScene(
            field, facts.config, cameras, facts.frames_per_second, facts.lengths_are_relative, facts.trained_on
        )


ENDONERF = RadianceMethod(EndoNeRF, presets.endonerf)
ENDOSURF = RadianceMethod(EndoSurf, presets.endosurf)
