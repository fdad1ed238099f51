"""What a method is: it trains on the training frames of a sequence and renders every frame; docs/plugins.md."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from endoprior.core.checks import input_error
from endoprior.core.config import OWN
from endoprior.model.method import METHODS, Method
from endoprior.model.presets import PRESETS, preset, preset_names

if TYPE_CHECKING:
    from endoprior.data import FrameSequence
    from endoprior.evaluation.context import Reconstruction
    from endoprior.model.scene import Scene

PICTURES = "pictures"
"""The method that reads what another program rendered."""


class BenchMethod(Protocol):
    """A method that benchmarks compare; an object, or a module with these two names."""

    options: Any
    """A frozen dataclass with every option at its default: bool, int, float, str, Literal, tuples or such dataclasses.

    If it is a `core.config.Config`, the spec's `set`, budgets and seed are in it, as in those of our presets.
    """

    def train(self, sequence: FrameSequence, options: Any, *, seed: int, out: Path) -> Reconstruction | Scene:
        """Train on one sequence.

        Args:
            sequence: all cameras and times; only training frames can be read (`FrameSequence.training_view`).
            options: as `self.options`, with the values of the spec.
            seed: of everything random; equal seeds must give equal results.
            out: folder of this training alone; it may not exist yet. If an earlier training with equal arguments was
                interrupted, its files are still there: resume from them or ignore them.
        Returns:
            What renders every frame. A `Scene` gets all scores, other reconstructions those of images and depth.
        Raises:
            InputError: the sequence or the options cannot be used.
        """
        ...


def method_names() -> tuple[str, ...]:
    """What specs can name: presets, the images of other programs, and methods of plugins that have no preset."""
    presets = preset_names()
    return (*presets, PICTURES, *(name for name in METHODS.names() if name not in (OWN, *presets)))


@cache
def method_named(name: str) -> BenchMethod:
    """The method of a name in `method_names()`.

    Raises:
        InputError: a plugin that cannot be used.
    """
    if name == PICTURES:
        from .picture_method import PictureMethod

        return PictureMethod()
    if name not in preset_names():
        found = METHODS.load(name)
        if isinstance(found, Method):
            raise input_error(f"method {name}", "a preset of its name", "none", "Add one: docs/plugins.md.")
        return found
    from .preset_method import PresetMethod

    return PresetMethod(preset(name))


def origin_of(name: str) -> str:
    """Package and version that a method comes from; empty for what is built in."""
    if name == PICTURES:
        return ""
    return (PRESETS if name in preset_names() else METHODS).origin(name)
