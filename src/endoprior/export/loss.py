"""What an export loses: its files, read again and rendered, beside the images of the scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .. import render
from ..core.ranges import evenly_spaced
from ..core.types import Splats
from ..model.scene import Scene
from .axes import ROTATIONS, rotated
from .formats import ExportFormat, ExportOptions
from .time_steps import TimeStep, selected_time_steps

MOST_FRAMES = 3
INVISIBLE_DB = 60.0
"""At this PSNR the error is a quarter of a step of 8 bits."""


def loss_note(scene: Scene, out: Path, options: ExportOptions, chosen: ExportFormat) -> str:
    """PSNR of a few of the files just written against the scene, in one line; empty for a format that is not read.

    Both are rendered as the endoscope sees them, without smoke.
    """
    if chosen.read is None:
        return ""
    steps = selected_time_steps(scene, options)
    some = [steps[k] for k in evenly_spaced(len(steps), MOST_FRAMES)]
    back = ROTATIONS[options.frame or chosen.default_axes].T
    errors = []
    for step in some:
        file = out / f"{step.name}{chosen.suffixes[0]}" if out.is_dir() else out
        found = _rendered(scene, step, rotated(chosen.read(file.read_bytes()), back))
        errors.append(float(((found - _as_trained(scene, step)) ** 2).mean()))
    psnr = float(-10 * np.log10(max(np.mean(errors), 1e-12)))
    count = "the image" if len(some) == 1 else f"{len(some)} images"
    result = f"{psnr:.1f} dB" if psnr < INVISIBLE_DB else f"over {INVISIBLE_DB:.0f} dB, no visible difference"
    why = "; one color for each Gaussian (docs/export.md)" if scene.config.render.color_slopes else ""
    return f"the file shows {count} of the scene with a PSNR of {result}{why}."


def _as_trained(scene: Scene, step: TimeStep) -> Tensor:
    if step.canonical:
        return _rendered(scene, step, step.splats(scene, "opencv"))
    return scene.render(step.time, step.camera(scene)).color.cpu()


@torch.no_grad()
def _rendered(scene: Scene, step: TimeStep, splats: Splats) -> Tensor:
    background = torch.tensor(scene.background, dtype=splats.means.dtype)
    return render.load("numba")(splats, step.camera(scene), background=background).color.clamp(0, 1)
