"""What the scenes of a method are made of, and which methods are installed; `training.method` adds how one trains.

Reading frames, run folders, logs, checkpoints, scoring and rendering are the same for all. All methods, our own too,
are entry points of the group `endoprior.methods` (docs/plugins.md), so that nothing here imports one.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cache
from typing import Any

from torch import Tensor

from ..core.checks import input_error
from ..core.config import OWN, Config
from ..core.config_io import from_dict
from ..core.types import Camera
from ..system.arrays_file import ArraySpec
from ..system.plugins import MissingPlugin, Registry
from .motion import Motion
from .rendered_scene import RenderedScene
from .scene_facts import SceneFacts


class SceneKind(ABC):
    """What the scenes of a method are made of; a method is a `training.method.Method`."""

    background = (0.0, 0.0, 0.0)
    """Color behind everything, in [0, 1], in training and where its scenes are rendered."""

    has_gaussians = True
    """Whether its scenes consist of Gaussians: a `Scene`; else they are only a `RenderedScene`."""

    config_type: type[Config] = Config
    """Type of its configs: a subclass has options of its own."""

    only: Mapping[str, Any] = {}
    """Fields of the config that it does not use, by dotted name, and their one value: others are rejected."""

    @abstractmethod
    def schema(self, cfg: Config) -> dict[str, ArraySpec]:
        """The arrays that its scenes are saved as, beside the cameras; `N` Gaussians, if there are any."""

    @abstractmethod
    def scene(self, arrays: Mapping[str, Tensor], cameras: tuple[Camera, ...], facts: SceneFacts) -> RenderedScene:
        """The scene whose arrays these are; they fit `schema`. InputError: a value that no scene can have."""

    def fitted(self, cfg: Config, num_frames: int) -> Config:
        """The config with what depends on the length of the sequence; fitting it again changes nothing."""
        return cfg.fitted(num_frames)

    def motion(self, cfg: Config) -> Motion:
        """How its Gaussians move; TypeError if it has none."""
        raise TypeError(f"{cfg.method} has no Gaussians")


def _problem(found: Any) -> str:
    if isinstance(found, SceneKind):
        return ""
    options = getattr(found, "options", None)
    if not dataclasses.is_dataclass(options) or isinstance(options, type):
        return f"options of type {type(options).__name__}"
    return "" if callable(getattr(found, "train", None)) else "no function train"


METHODS: Registry[Any] = Registry(
    "methods",
    "a Method, or options, a dataclass with its values, and train(sequence, options, seed, out)",
    _problem,
)
"""What can be trained. One that is no `Method` is known to `endoprior bench` only."""


@cache
def method_named(name: str) -> SceneKind:
    """The method of that name.

    Raises:
        InputError: none has this name, or it is one that only `endoprior bench` can train.
    """
    known = METHODS.names()
    if name not in known:
        fix = "Install the package with this plugin" if OWN in known else "Install endoprior again"
        fix = f"{fix}; `endoprior plugins` lists what is installed."
        got = f"{name!r:.80}, which no installed package has"
        raise MissingPlugin(str(input_error("method", f"one of {', '.join(known) or 'none'}", got, fix)))
    found = METHODS.load(name)
    if not isinstance(found, SceneKind):
        raise input_error("method", "a Method", f"{name}, which only trains in a benchmark", "`endoprior bench`.")
    return found


def method_of(cfg: Config) -> SceneKind:
    """The method of a config."""
    return method_named(cfg.method)


def config_from(values: Any) -> Config:
    """A config from the nested dict of a file; its type is that of its method.

    Raises:
        InputError: names the field, the expected and the actual value.
    """
    name = values.get("method", OWN) if isinstance(values, dict) else OWN
    return from_dict(method_named(name).config_type if isinstance(name, str) else Config, values)
