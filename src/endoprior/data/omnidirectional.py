"""Scaramuzza's omnidirectional camera, and the pinhole camera that shows the middle of its image.

A pixel at (u, v) from the center looks along (x, y, p(rho)), where (x, y) = A^-1 (u, v), rho = |(x, y)| and
p(rho) = a0 + a2 rho^2 + a3 rho^3 + a4 rho^4, with A = [[c, d], [e, 1]]. Pixel centers are integers here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TABLE_STEPS_PER_PX = 16
"""Entries of the table that inverts p, per pixel of radius: the error is far below 1/1000 px."""


@dataclass(frozen=True)
class Omnidirectional:
    """Intrinsics, px; `cx, cy` count pixel centers as integers."""

    width: int
    height: int
    cx: float
    cy: float
    a0: float
    a2: float
    a3: float
    a4: float
    c: float
    d: float
    e: float

    def forward(self, rho: NDArray[np.float64]) -> NDArray[np.float64]:
        """p(rho): how far forward a pixel at radius rho looks, in px."""
        return self.a0 + rho**2 * (self.a2 + rho * (self.a3 + rho * self.a4))

    def pinhole(self) -> tuple[float, float, float]:
        """(focal length, cx, cy), px, of the pinhole image of equal size; here pixel centers are halves.

        Its axis is the camera's own, and its nearest edge shows what the nearest edge of the original shows.
        """
        cx, cy = self.cx + 0.5, self.cy + 0.5
        nearest = min(cx, cy, self.width - cx, self.height - cy)
        return float(self.forward(np.float64(nearest))), cx, cy

    def pinhole_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """x and y, (H, W) each, of the original pixel that each pixel of the pinhole image shows (`cv2.remap`).

        Raises:
            ValueError: p does not describe a camera: its angle does not grow with the radius.
        """
        focal, cx, cy = self.pinhole()
        x = (np.arange(self.width) + 0.5 - cx) / focal
        y = (np.arange(self.height)[:, None] + 0.5 - cy) / focal
        slope = np.hypot(x, y)  # tangent of the angle to the axis
        far = math.hypot(self.width, self.height)
        radii = np.linspace(0, far, math.ceil(far) * TABLE_STEPS_PER_PX)
        angles = np.arctan2(radii, self.forward(radii))
        # Beyond its last valid pixel a fitted polynomial may decrease again; the image must not reach that far.
        turns = np.flatnonzero(np.diff(angles) <= 0)
        valid = slice(0, turns[0] + 1 if turns.size else None)
        angle = np.arctan(slope)
        if focal <= 0 or angle.max() > angles[valid][-1]:
            raise ValueError("the polynomial a0, a2, a3, a4 does not describe a camera; correct the calibration")
        rho = np.interp(angle, angles[valid], radii[valid])
        # rho / slope has the limit p(0) on the axis.
        scale = np.where(slope > 1e-9, rho / np.maximum(slope, 1e-9), self.a0)
        x, y = x * scale, y * scale
        return (self.c * x + self.d * y + self.cx).astype(np.float32), (self.e * x + y + self.cy).astype(np.float32)
