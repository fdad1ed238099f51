"""Choose the device that trains or renders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from ..core.checks import input_error
from ..core.config import Config
from ..doctor.choice import Wanted, choose_here
from ..system.console import say

if TYPE_CHECKING:
    from ..model.scene import RenderedScene


def on_device(scene: RenderedScene, wanted: Wanted, *, fp16_planes: bool = False) -> RenderedScene:
    """The scene on the chosen device. Prints the device and the reason, unless the user asked for the CPU.

    Args:
        fp16_planes: on a GPU, store a HexPlane as fp16 (`Scene.to`): for viewing, not for scores.
    Raises:
        InputError: CUDA was requested and is not usable.
    """
    choice = choose_here(wanted)
    if wanted != "cpu":
        say(choice.why)
    on_gpu = choice.device != "cpu"
    return scene.to(choice.device, backend=choice.backend if on_gpu else None, fp16_planes=fp16_planes and on_gpu)


def with_device(cfg: Config, wanted: Wanted, tell: Callable[[str], None] = say) -> Config:
    """The config with the rendering backend of the chosen device.

    Args:
        tell: takes the device and the reason, as a line for the user.
    Raises:
        InputError: CUDA was requested and is not usable, or the config names a GPU backend and the user the CPU.
    """
    from ..render import ON_GPU

    named = cfg.render.backend if cfg.render.backend in ON_GPU else None
    if named and wanted == "cpu":
        fix = f"Remove --device cpu or --render.backend {named}."
        raise input_error(f"--render.backend {named}", "--device cuda or auto", "cpu", fix)
    choice = choose_here("cuda" if named else wanted)
    tell(choice.why)
    if choice.device == "cpu" or named:
        return cfg
    return replace(cfg, render=replace(cfg.render, backend=choice.backend))
