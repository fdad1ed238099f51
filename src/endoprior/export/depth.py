"""Depth images: 16-bit PNG in steps of 0.01 mm, and float32 NPY in mm."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from ..data.images import encode_png
from ..model.scene import Scene
from ..model.surface import render_surface
from .formats import Format
from .options import ExportOptions
from .time_steps import TimeStep

PNG_STEPS_PER_MM = 100
"""Depth in a PNG is counted in 0.01 mm, so 65535 is 655.35 mm."""


def files(scene: Scene, step: TimeStep, options: ExportOptions) -> dict[str, bytes]:
    """Expected depth from the frame's own camera, as .png and .npy; 0 where there is no surface."""
    depth = render_surface(scene, step.time, step.camera(scene), options.min_alpha).depth
    stored = io.BytesIO()
    np.save(stored, depth)
    return {".png": depth_png(depth), ".npy": stored.getvalue()}


def depth_png(depth: NDArray[np.float32]) -> bytes:
    """A 16-bit gray PNG of (H, W) depth, mm; what is deeper than 655.35 mm does not fit and becomes 0, missing."""
    steps = np.rint(depth * np.float32(PNG_STEPS_PER_MM))
    fits = (steps > 0) & (steps <= 65535)
    return encode_png(np.where(fits, steps, 0).astype(np.uint16))


FORMAT = Format(
    suffixes=(".png", ".npy"),
    options=("times", "split", "min_alpha"),
    files=files,
    index_facts={"png_unit_mm": 1 / PNG_STEPS_PER_MM, "npy_unit_mm": 1.0, "missing": 0},
    holds="depth",
)
