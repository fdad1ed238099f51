"""Other colors for a trained scene: fixed over time, or one in each Gaussian.

Colors that do not change with time: what still changes in the video is motion. One color in each Gaussian, for programs
that know no others: without their slopes the colors of a trained scene are far from its picture, as they were trained
together. `one_color` finds those that come nearest to the picture of one camera. It is linear in them: picture = A c
with weights A >= 0, whose rows sum to the accumulated alpha. SIRT (Gilbert, "Iterative methods for the
three-dimensional reconstruction of an object from projections", 1972) with Nesterov's acceleration solves it within
bounds, from renderings and their gradients alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import render
from ..core.types import Camera, Splats
from .basis import spline_weights
from .gaussians import SH_C0, Gaussians, change_layout
from .scene import Scene, SingleScene, Window


def changes_color(scene: Scene) -> bool:
    """Whether the colors of its Gaussians can change with time."""
    return "sh_dc" in change_layout(scene.config)


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
    tensors, layout = dict(scene.gaussians.tensors), change_layout(scene.config)
    changes = tensors["changes"].detach().clone()
    weights = np.mean([spline_weights(time, changes.shape[1]) for time in times], axis=0)
    for name in layout.keys() & {"sh_dc", "gloss"}:
        colors = changes[:, :, layout[name]]  # a view: what is set to zero below is part of `changes`
        mean = torch.einsum("b,nbc->nc", torch.as_tensor(weights).to(colors), colors)
        tensors[name] = tensors[name].detach().clone()
        tensors[name][:, 0] += mean
        colors.zero_()
    return replace(scene, gaussians=Gaussians(tensors | {"changes": changes}))


ITERATIONS, FEW_ITERATIONS = 20, 5
"""Twice as many gain 0.2 dB; the few lose 0.9 dB."""
MIN_ALPHA, MIN_WEIGHT = 1e-3, 1e-2
"""Pixels and Gaussians with less count as if they had this much: nothing is known of them."""


def one_color(
    splats: Splats, camera: Camera, iterations: int = ITERATIONS, backend: render.Backend = "numba"
) -> Splats:
    """The same Gaussians without slopes, with the colors that show most nearly what `camera` sees.

    Gaussians that it does not see keep the color of their center, within [0, 1].
    """
    if splats.color_slopes is None:
        return splats
    rasterize, black = render.load(backend), splats.means.new_zeros(3)
    with torch.no_grad():
        seen = rasterize(splats, camera, background=black)
    target, alpha = seen.color.clamp(0, 1), seen.alpha.clamp(min=MIN_ALPHA)[..., None]

    def pulled_back(sh_dc: Tensor, picture: Tensor | None) -> Tensor:
        # A^T times a picture, or times what is left of the target, each pixel by its row's sum; (N, 1, 3).
        leaf = sh_dc.detach().requires_grad_()
        plain = replace(splats, sh=torch.cat([leaf, splats.sh[:, 1:]], 1), color_slopes=None)
        color = rasterize(plain, camera, background=black).color
        wanted = (target - color.detach()) / alpha if picture is None else picture
        return torch.autograd.grad((color * wanted).sum(), leaf)[0] / SH_C0

    least, most = (0 - 0.5) / SH_C0, (1 - 0.5) / SH_C0
    found = ahead = splats.sh[:, :1].detach().clamp(least, most)
    weights = pulled_back(found, torch.ones_like(target)).clamp(min=MIN_WEIGHT) * SH_C0
    momentum = 1.0
    for _ in range(iterations):
        better = (ahead + pulled_back(ahead, None) / weights).clamp(least, most)
        following = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
        ahead = (better + (momentum - 1) / following * (better - found)).clamp(least, most)
        found, momentum = better, following
    return replace(splats, sh=torch.cat([found, splats.sh[:, 1:]], 1), color_slopes=None)
