"""Depth from two eyes: the whole of it, and its parts."""

from __future__ import annotations

import common
import cv2
import numpy as np

from endoprior.prepare import stereo

FOCAL_PER_WIDTH, BASELINE_MM = 0.9, 4.2
PARTS = {
    "matching": [(stereo, "match_both_ways")],
    "refinement": [(stereo, "refine_disparity")],
    "smoothing": [(stereo, "smooth_disparity")],
    "holes": [(stereo, "drop_speckles"), (stereo, "fill_small_holes")],
}


def pair(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """A textured, bulging wall 50 to 90 mm away as the left and right eye see it, (H, W, 3) each, 0..255."""
    noise = np.random.default_rng(0).standard_normal((height, width, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 1.5)
    right = np.clip(110 + 35 * noise / noise.std(), 0, 255).astype(np.uint8)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    depth = 90 - 40 * np.exp(-(((x / width - 0.5) / 0.25) ** 2) - ((y / height - 0.5) / 0.25) ** 2)
    disparity = FOCAL_PER_WIDTH * width * BASELINE_MM / depth
    return cv2.remap(right, (x - disparity).astype(np.float32), y, cv2.INTER_CUBIC), right


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """One row for each picture, and rows of its parts."""
    measured = []
    for width, height in common.pictures(sizes):
        eyes = pair(width, height)
        steps = {"": lambda _, eyes=eyes: stereo.stereo_depth(*eyes, FOCAL_PER_WIDTH * eyes[0].shape[1], BASELINE_MM)}
        measured += common.rows("stereo", common.race(steps), None, (width, height))
        measured += common.part_rows("stereo", steps, PARTS, common.Size(None, width, height))
    return measured
