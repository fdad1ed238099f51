"""What a method is: it trains on the training frames of a sequence and renders every frame; docs/plugins.md."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from typing_extensions import override

from endoprior.core.checks import input_error
from endoprior.core.config import OWN, Config
from endoprior.model.method import METHODS, SceneKind
from endoprior.model.presets import PRESETS, preset, preset_names

if TYPE_CHECKING:
    from endoprior.data import FrameSequence
    from endoprior.evaluation.context import Reconstruction
    from endoprior.evaluation.pictures import Pictures
    from endoprior.model.scene import RenderedScene

PICTURES = "pictures"
"""The method that reads what another program rendered."""


class BenchMethod(Protocol):
    """A method that benchmarks compare; an object, or a module with these two names."""

    @property
    def options(self) -> Any:
        """A frozen dataclass with every option at its default: bool, int, float, str, Literal, tuples or such classes.

        If it is a `core.config.Config`, the spec's `set`, budgets and seed are in it, as in those of our presets.
        """
        ...

    def train(self, sequence: FrameSequence, options: Any, *, seed: int, out: Path) -> Reconstruction | RenderedScene:
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


@dataclass(frozen=True)
class PresetMethod:
    """Training as `endoprior train` does, with one preset."""

    options: Config

    def train(self, sequence: FrameSequence, options: Config, *, seed: int, out: Path) -> RenderedScene:
        """Train, or resume from the checkpoint in `out`; the scene is on the device that trained it."""
        from endoprior.runs.train import train
        from endoprior.training.trainer import device_for

        resume = (out / "checkpoint.safetensors").exists()
        if not resume:
            shutil.rmtree(out, ignore_errors=True)
        scene = train(sequence, replace(options, seed=seed), out, resume=resume)
        return scene.to(device_for(options.render.backend))


@dataclass(frozen=True)
class PictureOptions:
    """Where the rendered frames of another program are; see `Pictures`."""

    folder: str = ""
    """Color; empty if there are none of this sequence."""
    depth_folder: str = ""
    """Depth; empty if there is none."""
    depth_scale: float = 0.0
    """mm per unit of PNG depth; 0 if there is none."""
    name: str = ""


class PictureMethod(BenchMethod):
    """The rendered frames of another program: nothing is trained."""

    @property
    @override
    def options(self) -> PictureOptions:
        return PictureOptions()

    @override
    def train(self, sequence: FrameSequence, options: PictureOptions, *, seed: int, out: Path) -> Pictures:
        """Find the files of the test frames."""
        from endoprior.evaluation.pictures import Pictures

        depth = Path(options.depth_folder) if options.depth_folder else None
        about = {"depth_folder": depth, "depth_scale": options.depth_scale or None, "name": options.name}
        return Pictures(Path(options.folder), sequence, "test", **about)


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
        return PictureMethod()
    if name in preset_names():
        return PresetMethod(preset(name))
    found = METHODS.load(name)
    if isinstance(found, SceneKind):
        raise input_error(f"method {name}", "a preset of its name", "none", "Add one: docs/plugins.md.")
    return found


def origin_of(name: str) -> str:
    """Package and version that a method comes from; empty for what is built in."""
    if name == PICTURES:
        return ""
    return (PRESETS if name in preset_names() else METHODS).origin(name)
