"""The tissue surface that a camera sees at one time: expected depth, color, and which points it shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import bilinear, cells_at, expected_depth, project
from ..core.types import Camera
from .scene import Scene

HIDDEN_SHARE = 0.04
"""A point is hidden if it lies deeper than the rendered surface at its pixel by more than this share (docs/log.md)."""


@dataclass(frozen=True)
class Surface:
    """What one camera sees."""

    depth: NDArray[np.float32]
    """(H, W) z, mm; 0 where no surface is rendered."""
    color: NDArray[np.float32]
    """(H, W, 3) in [0, 1], without the background; 0 where no surface is rendered."""
    camera: Camera


def render_surface(scene: Scene, time: float, camera: Camera, min_alpha: float = 0.5) -> Surface:
    """Render `scene` and divide depth and color by the accumulated opacity where that is at least `min_alpha`."""
    out = scene.render(time, camera)
    alpha = out.alpha.cpu().numpy()
    opaque = alpha[..., None] >= min_alpha
    behind = (1 - alpha[..., None]) * np.asarray(scene.background, np.float32)
    color = np.where(opaque, (out.unclamped_color.cpu().numpy() - behind) / np.where(opaque, alpha[..., None], 1), 0)
    depth = expected_depth(out.depth.cpu().numpy(), alpha, min_alpha)
    return Surface(depth, color.clip(0, 1).astype(np.float32), camera)


def depth_at(surface: Surface, pixels: NDArray) -> NDArray[np.float64]:
    """(P,) depth between the pixel centers around (P, 2) pixels; NaN where one of them shows no surface."""
    depth = np.where(surface.depth > 0, surface.depth, np.nan).astype(np.float64)
    return bilinear(depth, pixels)


def shown_pixels(pixels: NDArray, tissue_mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(P,) whether (P, 2) pixels are inside the image and on tissue.

    Args:
        tissue_mask: (H, W) False under tools.
    """
    height, width = tissue_mask.shape
    x, y = cells_at(pixels, width, height)
    return (pixels >= 0).all(1) & (pixels <= (width, height)).all(1) & tissue_mask[y, x]


def project_visible(
    points: NDArray, surface: Surface, tissue_mask: NDArray[np.bool_] | None = None
) -> tuple[NDArray, NDArray[np.bool_]]:
    """(P, 2) pixels of world points (P, 3), and (P,) whether the image shows them.

    It does where they are inside the image and neither behind rendered tissue nor under a tool.

    Args:
        tissue_mask: (H, W) False under tools; None: no tools.
    """
    pixels, z = project(points.astype(np.float64), surface.camera)
    mask = np.ones(surface.depth.shape, bool) if tissue_mask is None else tissue_mask
    depth = depth_at(surface, pixels)
    with np.errstate(invalid="ignore"):  # NaN: no surface, so nothing is visible
        return pixels, (z > 0) & shown_pixels(pixels, mask) & (z <= depth * (1 + HIDDEN_SHARE))
