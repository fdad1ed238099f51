"""The tissue surface that a camera sees at one moment: expected depth, and color where there is any."""

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
    """(H, W) z, mm; 0 where no surface is drawn."""
    color: NDArray[np.float32]
    """(H, W, 3) in [0, 1], freed from the black background; 0 where no surface is drawn."""
    camera: Camera


def seen_surface(scene: Scene, time: float, camera: Camera, min_alpha: float) -> Surface:
    """Draw `scene` and divide depth and color by the accumulated opacity where that is at least `min_alpha`."""
    drawn = scene.render(time, camera)
    alpha = drawn.alpha.numpy()
    shown = alpha[..., None] >= min_alpha
    color = np.where(shown, drawn.color.numpy() / np.where(shown, alpha[..., None], 1), 0)
    depth = expected_depth(drawn.depth.numpy(), alpha, min_alpha)
    return Surface(depth, color.clip(0, 1).astype(np.float32), camera)
