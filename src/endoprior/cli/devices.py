"""Move a scene to the device that renders it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..doctor.choice import Wanted, choose_here
from ..system.console import say

if TYPE_CHECKING:
    from ..model.scene import Scene


def on_device(scene: Scene, wanted: Wanted, *, fp16_planes: bool = False) -> Scene:
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
