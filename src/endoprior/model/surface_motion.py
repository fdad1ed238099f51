"""Motion of the tissue surface of a scene: how much it is stretched since a frame, around points and everywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import back_project, pixel_centers
from .carry import carry_points
from .measures import neighborhoods, principal_stretches
from .scene import Scene
from .surface import render_surface

SAMPLE_COLUMNS = 40
"""Surface points along a row of the image. Stretch is fit to 24 of them, so over about 14 % of the image's width: over
less, errors of the tracks show as stretch; over more, real differences blur."""


class SurfaceMotion:
    """The surface that the camera of one frame sees, and its stretch since then."""

    def __init__(self, scene: Scene, since: int, min_alpha: float = 0.5) -> None:
        """Render the surface of frame `since`, and sample it on a grid."""
        self._scene, self.since = scene, since
        surface = render_surface(scene, self._time(since), scene.cameras[since], min_alpha)
        step = max(surface.camera.width // SAMPLE_COLUMNS, 1)
        depth = surface.depth[step // 2 :: step, step // 2 :: step]
        pixels = pixel_centers(surface.camera.width, surface.camera.height)[step // 2 :: step, step // 2 :: step]
        seen = depth > 0
        self.samples = back_project(pixels[seen].astype(np.float64), depth[seen].astype(np.float64), surface.camera)
        """(S, 3) points of the surface in that frame, world axes, mm."""

    def _time(self, frame: int) -> float:
        return frame / len(self._scene.cameras)

    def stretch(self, points: NDArray, frames: list[int]) -> NDArray[np.float64]:
        """Largest principal stretch around points since the frame of the surface.

        Args:
            points: (P, 3) where they are in that frame, mm.
        Returns:
            (F, P) for each of `frames`; 1: unchanged. NaN for points that are not on the surface.
        """
        found = np.full((len(frames), len(points)), np.nan)
        on_surface = np.isfinite(points).all(1)
        if not len(self.samples) or not on_surface.any():
            return found
        nearest, around = neighborhoods(points[on_surface], self.samples)
        used, places = np.unique(nearest[around], return_inverse=True)
        on_surface[on_surface] = around
        if not len(used):
            return found
        before = self.samples[used]
        times = [self._time(frame) for frame in (self.since, *frames)]
        moved = carry_points(self._scene, before, np.zeros(len(used), np.intp), times)[1:].astype(np.float64)
        places = places.reshape(-1, nearest.shape[1])
        for found_there, after in zip(found, moved, strict=True):
            found_there[on_surface] = principal_stretches(before[places], after[places])[:, 0]
        return found
