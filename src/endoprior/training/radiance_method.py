"""A method that is a radiance field."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from ..core.checks import InputError
from ..core.config import Config
from ..core.types import Camera
from ..data import FrameSequence
from ..model.method import Method
from ..model.scene_facts import SceneFacts
from ..radiance.field import RadianceField
from ..radiance.scene import RadianceScene
from ..system.arrays_file import ArraySpec, part
from .radiance_trainer import RadianceTrainer


class RadianceMethod(Method):
    """See `Method`."""

    has_gaussians = False

    def __init__(self, kind: type[RadianceField], config: Callable[[], Config]) -> None:
        """Args: kind: of the field. config: what its preset starts from."""
        self.kind, self._config = kind, config

    def config(self) -> Config:
        """See `Method.config`."""
        return self._config()

    def trainer(self, sequence: FrameSequence, cfg: Config) -> RadianceTrainer:
        """See `Method.trainer`."""
        return RadianceTrainer(sequence, cfg, self.kind)

    def schema(self, cfg: Config) -> dict[str, ArraySpec]:
        """See `Method.schema`."""
        return {f"field.{name}": spec for name, spec in self.kind.schema(cfg.radiance).items()}

    def scene(self, arrays: Mapping[str, Tensor], cameras: tuple[Camera, ...], facts: SceneFacts) -> RadianceScene:
        """See `Method.scene`."""
        field = self.kind(facts.config.radiance)
        field.load_state_dict(part(arrays, "field."))
        if wrong := field.wrong_values():
            raise InputError(f"expected {wrong}; got something else.")
        return RadianceScene(field, facts.config, cameras, facts.frames_per_second, facts.lengths_are_relative)
