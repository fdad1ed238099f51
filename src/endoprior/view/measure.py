"""Measure distances: pick points on the rendered surface, follow them over time, describe the result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import back_project, length_unit
from ..core.types import Camera


@dataclass(frozen=True)
class Measurement:
    """One or two picked points."""

    frame: int
    """Frame of the last picked point."""
    paths: NDArray[np.float64]
    """(T, K, 3) positions of the K points in each frame, world axes, mm; NaN where unknown."""

    def ends(self, frame: int) -> NDArray[np.float64]:
        """(K, 3) the points in `frame`; (0, 3) where they are unknown."""
        points = self.paths[frame]
        return points if np.isfinite(points).all() else points[:0]

    @property
    def distances(self) -> NDArray[np.float64]:
        """(T,) distance between two points in each frame, mm; NaN where unknown, and for a single point."""
        if self.paths.shape[1] < 2:
            return np.full(len(self.paths), np.nan)
        return np.linalg.norm(self.paths[:, 1] - self.paths[:, 0], axis=-1)


def pick(depth: NDArray, camera: Camera, pixel: tuple[float, float]) -> NDArray[np.float64] | None:
    """The point of the surface behind a pixel.

    Args:
        depth: (H, W) z of the surface, mm; 0 where there is none.
        pixel: (x, y), px.
    Returns:
        (3,) world axes, mm; None outside the image and where there is no surface.
    """
    x, y = (int(np.floor(v)) if np.isfinite(v) else -1 for v in pixel)
    if not (0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]) or not depth[y, x] > 0:
        return None
    return back_project(np.array(pixel, np.float64), np.float64(depth[y, x]), camera)


def measurement_text(measured: Measurement | None, frame: int, relative: bool) -> str:
    """The measurement in `frame` as text. `relative`: lengths have no known unit."""
    if measured is None:
        return "Click two points."
    if measured.paths.shape[1] < 2:
        return "Click a second point."
    unit = length_unit(relative)
    distances = measured.distances
    if not np.isfinite(distances[frame]):
        return f"Measured in frame {measured.frame}; the points are unknown in this one."
    text = f"**{distances[frame]:.2f} {unit}**"
    if np.isfinite(distances).sum() > 1:
        change = distances[frame] - distances[measured.frame]
        low, high = np.nanmin(distances), np.nanmax(distances)
        text += f"  \n{change:+.2f} since frame {measured.frame}; {low:.2f} to {high:.2f} over all frames"
    return text
