"""A scene without its highlights: the color that tissue has where no light is reflected into the camera.

A highlight moves over tissue, so most tissue is seen without it at another time. The temporal color of each Gaussian is
fitted again to the times at which the frames show it free of highlights. Geometry stays as it is, and what was taken
away is additive: the picture with highlights minus the one without. `N` Gaussians, `F` frames, `B` basis functions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ..core.checks import InputError
from ..core.geometry import cells_at
from ..core.types import Frame
from ..priors.specular import specular_likelihood
from .basis import spline_weights
from .colors import changes_color
from .gaussians import SH_C0, Gaussians, change_layout
from .scene import Scene, SingleScene
from .surface import FramesOf, project_visible, render_surface

REACH_PX = 11
"""Side of the square around a pixel whose largest likelihood counts, in an image 640 px wide: a Gaussian's footprint,
and the bloom around a highlight."""
TISSUE, HIGHLIGHT = 0.05, 0.3
"""Likelihoods up to which a pixel is free, and from which on it is not."""
UNTOUCHED = 0.05
"""A Gaussian that every frame shows at least this near to free keeps its color."""
UNSEEN = 0.1
"""Weight of a time at which no frame shows a Gaussian: its color then is a guess."""
MIN_FREE_FRAMES = 2.0
"""A Gaussian with fewer free frames, likelihoods added up, gets the color of those around it."""
NEIGHBORS = 8
ROUNDS, BRIGHTER = 4, 0.05
"""Rounds of weighting, and by how much a color must be brighter, of 1, to count half."""
RIDGE = 0.05
"""Pulls the change over time to 0 where nothing is known: weight of a frame to each coefficient squared."""
MAX_CHUNK = 2**24
"""Numbers of one array of what is solved at a time."""


def without_highlights(scene: Scene, frames_of: FramesOf) -> Scene:
    """`scene` with highlights taken out of the colors of its Gaussians.

    Args:
        frames_of: what each window was trained on; it says where highlights are.
    Raises:
        InputError: its colors do not change with time, so that a highlight cannot be told from tissue.
    """
    if not changes_color(scene):
        kind = scene.config.deformation.kind
        raise InputError(
            f"highlights: expected a scene whose colors change with time; got deformation.kind {kind}. "
            "Train it with --preset default."
        )
    return scene.changed(lambda part, window: _refitted_scene(part, frames_of(window)))


def _refitted_scene(scene: SingleScene, frames: Iterable[Frame]) -> SingleScene:
    """Args: frames: those it was trained on."""
    free, times = _free_of_highlights(scene, frames)
    cfg, tensors = scene.config, dict(scene.gaussians.tensors)
    part = change_layout(cfg)["sh_dc"]
    changes, sh_dc = tensors["changes"].detach().clone(), tensors["sh_dc"].detach().clone()
    basis = torch.as_tensor(np.stack([spline_weights(t, changes.shape[1]) for t in times])).to(changes)
    weights = torch.as_tensor(np.where(np.isnan(free), UNSEEN, free)).to(changes)
    touched = np.nanmin(free, axis=1, initial=1) < 1 - UNTOUCHED
    chunk = max(MAX_CHUNK // (max(basis.shape) * basis.shape[1]), 1)
    for some in torch.from_numpy(np.flatnonzero(touched)).to(changes.device).split(chunk):
        sh_dc[some, 0], changes[some, :, part] = _refitted(
            sh_dc[some, 0], changes[some][:, :, part], basis, weights[some]
        )
    means = tensors["means"].detach().cpu().numpy()
    known = np.asarray(np.nansum(free, axis=1) >= MIN_FREE_FRAMES)
    never_seen = np.asarray(np.isnan(free).all(1))
    unseen = torch.from_numpy(never_seen).to(changes.device)
    for new, old in ((sh_dc, tensors["sh_dc"]), (changes[:, :, part], tensors["changes"][:, :, part])):
        _take_from_neighbors(means, known, np.asarray(touched & ~known), new)
        taken = new - old.detach()
        _take_from_neighbors(means, ~never_seen, never_seen, taken)
        new[unseen] += taken[unseen]
    if tensors.pop("gloss", None) is not None:  # the right eye sees the same tissue
        changes = changes[:, :, : change_layout(cfg)["gloss"].start]
        cfg = replace(cfg, data=replace(cfg.data, eyes="left"))
    gaussians = Gaussians(tensors | {"sh_dc": sh_dc, "changes": changes})
    return replace(scene, gaussians=gaussians, config=cfg, baseline_mm=0.0)


def _free_of_highlights(scene: SingleScene, frames: Iterable[Frame]) -> tuple[NDArray[np.float32], list[float]]:
    """(N, F) how surely each frame shows each Gaussian free of highlights, in [0, 1], NaN where it does not show it.

    Also the F times.
    """
    free, times = [], []
    for frame in frames:
        means = scene.at(frame.time).means.cpu().numpy()
        surface = render_surface(scene, frame.time, frame.camera)
        pixels, seen = project_visible(means, surface, frame.tissue_mask)
        height, width = frame.tissue_mask.shape
        side = max(round(REACH_PX * width / 640), 1)
        likelihood = cv2.dilate(specular_likelihood(frame.rgb), np.ones((side, side), np.uint8))
        share = np.full(len(means), np.nan, np.float32)
        x, y = cells_at(pixels[seen], width, height)
        share[seen] = np.clip((HIGHLIGHT - likelihood[y, x]) / (HIGHLIGHT - TISSUE), 0, 1)
        free.append(share)
        times.append(frame.time)
    return np.stack(free, 1), times


def _refitted(sh_dc: Tensor, coefficients: Tensor, basis: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Colors (n, 3) and temporal coefficients (n, B, 3) of least squares, weighted by time.

    A time at which a Gaussian is brighter than its mean counts less, in a few rounds: light adds to a color, so the rim
    of a highlight is known by it.

    Args:
        basis: (F, B). weights: (n, F).
    """
    shown = sh_dc[:, None] + torch.einsum("fb,nbc->nfc", basis, coefficients)
    brightness, known = shown.mean(-1) * SH_C0, weights
    for _ in range(ROUNDS):
        share = weights / weights.sum(1, keepdim=True).clamp(min=1e-6)
        mean = torch.einsum("nf,nfc->nc", share, shown)
        excess = (brightness - mean.mean(-1, keepdim=True) * SH_C0).clamp(min=0)
        weights = known / (1 + (excess / BRIGHTER) ** 2)
    weighted = weights[:, :, None] * basis
    normal = torch.einsum("nfb,fd->nbd", weighted, basis)
    normal = normal + RIDGE * torch.eye(basis.shape[1]).to(normal)
    right = torch.einsum("nfb,nfc->nbc", weighted, shown - mean[:, None])
    return mean, torch.linalg.solve(normal, right)


def _take_from_neighbors(
    means: NDArray[np.float32], known: NDArray[np.bool_], unknown: NDArray[np.bool_], values: Tensor
) -> None:
    """Set the `unknown` rows of `values` (N, ...) to the mean of the nearest `known` ones."""
    if not unknown.any() or not known.any():
        return
    rows = np.flatnonzero(known)
    k = min(NEIGHBORS, len(rows))
    _, nearest = KDTree(means[rows]).query(means[unknown], k)
    nearest = torch.from_numpy(rows[np.reshape(nearest, (-1, k))]).to(values.device)
    values[torch.from_numpy(unknown).to(values.device)] = values[nearest].mean(1)
