"""A scene whose colors do not change with time: what still changes in its video is motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from .attributes import motion_layout
from .basis import basis_weights
from .gaussians import Gaussians
from .scene import Scene, Window
from .single_scene import SingleScene


def changes_color(scene: Scene) -> bool:
    """Whether the colors of its Gaussians can change with time."""
    return "sh_dc" in motion_layout(scene.config.deformation)


def with_fixed_color(scene: Scene, times: Sequence[float]) -> Scene:
    """`scene` with the color of each Gaussian fixed to its mean over `times`, in [0, 1]; itself if none changes.

    Of several windows, each takes the mean over those times that are its own; where there is none, over its middle.
    """
    if not changes_color(scene):
        return scene
    frames = np.asarray(times) * len(scene.cameras)

    def fixed(part: SingleScene, window: Window) -> SingleScene:
        own = frames[(frames >= window.start) & (frames < window.stop)] - window.start
        return _fixed(part, own / len(part.cameras) if len(own) else np.array([0.5]))

    return scene.changed(fixed)


def _fixed(scene: SingleScene, times: NDArray[np.float64]) -> SingleScene:
    cfg, tensors = scene.config.deformation, dict(scene.gaussians.tensors)
    weights = np.mean([basis_weights(time, cfg.basis) for time in times], axis=0)
    motion = tensors["motion"].detach().clone()
    colors = motion[:, :, motion_layout(cfg)["sh_dc"]]  # a view: what is set to zero below is part of `motion`
    mean = torch.einsum("b,nbc->nc", torch.as_tensor(weights).to(colors), colors)
    tensors["sh_dc"] = tensors["sh_dc"].detach() + mean[:, None]
    colors.zero_()
    return replace(scene, gaussians=Gaussians(tensors | {"motion": motion}))
