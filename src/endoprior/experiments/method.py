"""What a method is: it trains on the training frames of a sequence and renders every frame; docs/plugins.md."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, get_args

from ..core.presets import PresetName, preset
from ..system.plugins import Registry

if TYPE_CHECKING:
    from ..data import FrameSequence
    from ..evaluation.rendered import Reconstruction
    from ..model.scene import Scene

PICTURES = "pictures"
"""The method that reads what another program rendered."""


class Method(Protocol):
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


def _builtin(name: str) -> Method:
    if name == PICTURES:
        from .picture_method import PictureMethod

        return PictureMethod()
    from .preset_method import PresetMethod

    return PresetMethod(preset(name))


def _problem(found: Any) -> str:
    options = getattr(found, "options", None)
    if not dataclasses.is_dataclass(options) or isinstance(options, type):
        return f"options of type {type(options).__name__}"
    return "" if callable(getattr(found, "train", None)) else "no function train"


REGISTRY: Registry[Method] = Registry(
    "methods",
    (*get_args(PresetName), PICTURES),
    _builtin,
    "options, a dataclass with its values, and train(sequence, options, seed, out)",
    _problem,
)
"""Our presets, the images of other programs, and plugins."""
