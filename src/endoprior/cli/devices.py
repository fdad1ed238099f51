"""Moving a scene to where the user wants it drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..doctor.choice import Wanted, choose_here
from .progress import say

if TYPE_CHECKING:
    from ..model.scene import Scene


def on_device(scene: Scene, wanted: Wanted, *, fp16_planes: bool = False) -> Scene:
    """The scene on the chosen device; which one, and why, is said unless it is the CPU as asked.

    Args:
        fp16_planes: on a GPU, planes in half precision (`Scene.to`): for images to look at, not for scores.
    Raises:
        InputError: CUDA was asked for and cannot be had.
    """
    choice = choose_here(wanted)
    if wanted != "cpu":
        say(choice.why)
    on_gpu = choice.device != "cpu"
    return scene.to(choice.device, backend=choice.backend if on_gpu else None, fp16_planes=fp16_planes and on_gpu)
