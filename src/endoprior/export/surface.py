"""The tissue surface that a camera sees at one time: expected depth, and color."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import expected_depth
from ..core.types import Camera
from ..model.scene import Scene


@dataclass(frozen=True)
class Surface:
    """What one camera sees."""

    depth: NDArray[np.float32]
    """(H, W) z, mm; 0 where no surface is rendered."""
    color: NDArray[np.float32]
    """(H, W, 3) in [0, 1], without the black background; 0 where no surface is rendered."""
    camera: Camera


def render_surface(scene: Scene, time: float, camera: Camera, min_alpha: float) -> Surface:
    """Render `scene` and divide depth and color by the accumulated opacity where that is at least `min_alpha`."""
    out = scene.render(time, camera)
    alpha = out.alpha.numpy()
    opaque = alpha[..., None] >= min_alpha
    color = np.where(opaque, out.color.numpy() / np.where(opaque, alpha[..., None], 1), 0)
    depth = expected_depth(out.depth.numpy(), alpha, min_alpha)
    return Surface(depth, color.clip(0, 1).astype(np.float32), camera)
