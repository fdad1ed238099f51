"""Smoke of electrocautery: a drifting veil that comes and goes between the endoscope and all that it sees."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import Eye
from .config import PhantomConfig
from .motion import smooth_step
from .noise import fractal

_PUFF_FRAMES = 40
"""A puff of smoke comes about once in so many frames."""
_DEPTH_MM = 80.0
"""Depth for which the densest smoke is given."""
_VEIL_MM = 50.0
"""Distance at which the clouds are as large as they look."""
_COLOR = np.array([0.32, 0.335, 0.35], np.float32)
"""Linear radiance of dense smoke on the optical axis, where tissue of medium color has about 0.3."""
_COARSE = 8
"""Samples of the image per sample of the clouds."""


@dataclass(frozen=True)
class Smoke:
    """The smoke of one seed."""

    seed: int
    frames: int
    peaks: NDArray[np.float64]
    """(P,) density of each puff at its height, 0..1."""
    strongest: float
    """Share of the light that smoke of density 1 takes away within 80 mm, 0..1."""

    @staticmethod
    def of(cfg: PhantomConfig, strongest: float) -> Smoke:
        """Choose the puffs."""
        rng = np.random.default_rng([cfg.seed, 10])
        peaks = rng.uniform(0.6, 1.0, max(1, round(cfg.frames / _PUFF_FRAMES)))
        return Smoke(cfg.seed, cfg.frames, peaks, strongest)

    def density(self, phase: float) -> float:
        """0..1 at time `phase` in [0, 1]; 0 at both ends, so that the first frame sets the exposure without smoke."""
        count = len(self.peaks)
        k = min(int(phase * count), count - 1)
        local = phase * count - k
        return float(self.peaks[k] * smooth_step(0.06, 0.35, local) * (1 - smooth_step(0.55, 0.97, local)))

    def veiled(
        self, radiance: NDArray, z: NDArray, phase: float, eye: Eye, focal: float, center: tuple[float, float]
    ) -> NDArray:
        """(SH, SW, 3) float32 linear radiance behind smoke, mixed with the light that the smoke scatters back.

        Args:
            radiance: (SH, SW, 3) without smoke. z: (SH, SW) depth of what is seen, mm.
            eye: the camera, in the axes of the endoscope's left one, with which the smoke moves.
            focal, center: of the sample grid, px.
        """
        density = self.density(phase)
        if density == 0:
            return radiance
        height, width = z.shape
        y, x = np.mgrid[:height:_COARSE, :width:_COARSE].astype(np.float32)
        x, y = (x - center[0]) / focal, (y - center[1]) / focal
        clouds = self._clouds(x * _VEIL_MM + eye.center[0], y * _VEIL_MM + eye.center[1], phase) * density
        # The light guides shine less away from the optical axis.
        axis = (1 / (1 + np.hypot(x, y) ** 2) ** 2).astype(np.float32)
        columns, rows = np.meshgrid(*(np.arange(size, dtype=np.float32) / _COARSE for size in (width, height)))
        dense, lit = (
            cv2.remap(coarse, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for coarse in (clouds, axis)
        )
        lost = 1 - np.exp(np.float32(np.log(1 - self.strongest) / _DEPTH_MM) * dense * z)
        return radiance + lost[..., None] * (_COLOR * lit[..., None] - radiance)

    def _clouds(self, x: NDArray, y: NDArray, phase: float) -> NDArray:
        """In [0.12, 1.8]: relative density of the smoke at x, y, mm to the right and down."""
        time = phase * (self.frames - 1)
        # It rises and swirls; the slow field carries the fine one along.
        slow = fractal(x / 30 + 0.02 * time, y / 30 + 0.035 * time, 2, self.seed + 60)
        fine = fractal(x / 11 + 1.2 * slow - 0.03 * time, y / 11 + 0.08 * time, 3, self.seed + 61)
        return np.clip(0.8 + 1.5 * slow + 0.6 * fine, 0.12, 1.8).astype(np.float32)
