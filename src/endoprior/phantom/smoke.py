"""Smoke of electrocautery: a drifting veil that comes and goes between the endoscope and all that it sees."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import PhantomConfig
from .eye import Eye
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
        self,
        radiance: NDArray[np.float32],
        z: NDArray[np.float32],
        phase: float,
        eye: Eye,
        focal: float,
        center: tuple[float, float],
    ) -> NDArray[np.float32]:
        """(SH, SW, 3) linear radiance behind smoke.

        Args:
            radiance: (SH, SW, 3) without smoke. z: (SH, SW) depth of what is seen, mm.
            phase: time in [0, 1].
            eye: the camera, in the axes of the endoscope's left one, with which the smoke moves.
            focal, center: of the sample grid, px.
        """
        density = self.density(phase)
        if density == 0:
            return radiance
        height, width = z.shape
        y, x = np.mgrid[:height:_COARSE, :width:_COARSE].astype(np.float32)
        x, y = (x - center[0]) / focal, (y - center[1]) / focal
        seen = x * _VEIL_MM + eye.center[0], y * _VEIL_MM + eye.center[1]
        return _blend(radiance, z, self._clouds(*seen, phase) * density, np.hypot(x, y), self.strongest)

    def _clouds(self, x: NDArray, y: NDArray, phase: float) -> NDArray[np.float32]:
        """In [0.12, 1.8]: relative density of the smoke at x, y, mm to the right and down."""
        time = phase * (self.frames - 1)
        # It rises and swirls; the slow field carries the fine one along.
        slow = fractal(x / 30 + 0.02 * time, y / 30 + 0.035 * time, 2, self.seed + 60)
        fine = fractal(x / 11 + 1.2 * slow - 0.03 * time, y / 11 + 0.08 * time, 3, self.seed + 61)
        return np.clip(0.8 + 1.5 * slow + 0.6 * fine, 0.12, 1.8).astype(np.float32)


def _blend(
    radiance: NDArray[np.float32], z: NDArray[np.float32], clouds: NDArray[np.float32], off: NDArray, strongest: float
) -> NDArray[np.float32]:
    """Mix radiance (SH, SW, 3) with the light that smoke scatters back.

    Args:
        clouds: (CH, CW) density. off: (CH, CW) tangent of the angle to the optical axis, away from which the light
            guides shine less.
    """
    grid = (np.arange(z.shape[1], dtype=np.float32) / _COARSE, np.arange(z.shape[0], dtype=np.float32) / _COARSE)
    dense, axis = _upsampled(clouds, *grid), _upsampled((1 / (1 + off**2) ** 2).astype(np.float32), *grid)
    lost = 1 - np.exp(np.float32(np.log(1 - strongest) / _DEPTH_MM) * dense * z)
    return radiance + lost[..., None] * (_COLOR * axis[..., None] - radiance)


def _upsampled(coarse: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
    """(SH, SW) linear interpolation of `coarse` (CH, CW) at columns x (SW,) and rows y (SH,)."""
    columns, rows = np.meshgrid(x, y)
    return cv2.remap(coarse, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
