"""Branching blood vessels, drawn in material coordinates, so that they move with the tissue."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .surface import LIVER, Organs, Plane

TREES = 1000
"""Number of trees, over the whole tissue of a camera that stands still."""
_TISSUE_MM2 = 30_000
"""Its usual size."""
_STEP_MM = 0.7
_SUBPIXEL_BITS = 4


class _Branch(NamedTuple):
    """One vessel to be grown: start (a, b) mm, heading rad, caliber and length mm."""

    start: NDArray[np.float64]
    heading: float
    caliber: float
    length: float


def vessel_maps(
    plane: Plane, a: NDArray, b: NDArray, organs: Organs, rng: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """Grow trees from random points; each stays on its own organ and splits into thinner branches.

    Returns:
        two float32 maps in [0, 1] on the material grid a, b (TH, TW): trunks (caliber above 0.3 mm) and twigs.
    """
    shape = a.shape
    mm_per_texel = float(np.abs(np.diff(a[shape[0] // 2])).mean())
    trunks, twigs = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    low, high = np.array([a.min(), b.min()]), np.array([a.max(), b.max()])
    trees = round(TREES * np.prod(high - low) / _TISSUE_MM2) if plane.metric else TREES
    pending = []
    for _ in range(trees):
        start, heading = rng.uniform(low, high), rng.uniform(0, 2 * np.pi)
        caliber = 0.16 + 0.34 * rng.uniform() ** 4
        pending.append(_Branch(start, heading, caliber, rng.uniform(10, 26)))
    while pending:
        branch = pending.pop()
        points, children = _grow(branch, plane, organs, rng)
        pending.extend(children)
        texels = np.stack(plane.grid(points[:, 0], points[:, 1]), -1) * [shape[1], shape[0]] - 0.5
        fixed = np.round(texels * 2**_SUBPIXEL_BITS).astype(np.int32).reshape(-1, 1, 2)
        target = trunks if branch.caliber > 0.3 else twigs
        # Pieces of four steps taper to half the caliber, so that no vessel ends bluntly.
        for k in range(0, len(fixed) - 1, 4):
            caliber = branch.caliber * (1 - 0.5 * k * _STEP_MM / branch.length)
            width = caliber / mm_per_texel
            # Lines are at least one texel wide; thinner vessels are fainter instead.
            strength = int(255 * min(1.0, width) * (0.55 + 0.45 * min(1.0, caliber / 0.35)))
            piece = fixed[k : k + 5]
            cv2.polylines(target, [piece], False, strength, max(1, round(width)), cv2.LINE_AA, _SUBPIXEL_BITS)
    # Vessels lie under the serosa, trunks deeper than twigs.
    blurred = (
        cv2.GaussianBlur(drawn, (0, 0), max(depth_mm / mm_per_texel, 0.4)).astype(np.float32) / 255
        for drawn, depth_mm in ((trunks, 0.11), (twigs, 0.06))
    )
    return next(blurred), next(blurred)


def _grow(branch: _Branch, plane: Plane, organs: Organs, rng: np.random.Generator) -> tuple[NDArray, list[_Branch]]:
    """Walk one branch until it is long enough or leaves its organ; return its points (n, 2) and its children."""
    count = max(2, int(branch.length / _STEP_MM))
    # A slow oscillation gives the winding course, white noise the small kinks.
    turns = rng.normal(0, 0.16, count) + 0.16 * np.sin(np.arange(count) * rng.uniform(0.2, 0.5) + rng.uniform(0, 6.3))
    headings = branch.heading + np.cumsum(turns)
    points = branch.start + np.cumsum(_STEP_MM * np.stack([np.cos(headings), np.sin(headings)], -1), 0)
    grid_u, grid_v = plane.grid(points[:, 0], points[:, 1])
    height, width = organs.owner.shape
    row = np.clip((grid_v * height).astype(int), 0, height - 1)
    column = np.clip((grid_u * width).astype(int), 0, width - 1)
    owner = organs.owner[row, column]
    inside = (grid_u >= 0) & (grid_u < 1) & (grid_v >= 0) & (grid_v < 1)
    stays = inside & (owner == owner[0]) & (owner != LIVER)
    length = count if stays.all() else int(stays.argmin())
    children = []
    if branch.caliber > 0.10:
        for k in np.flatnonzero(rng.uniform(size=length) < 0.17):
            heading = headings[k] + rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.1)
            caliber = branch.caliber * rng.uniform(0.5, 0.72)
            left = (branch.length - k * _STEP_MM) * rng.uniform(0.5, 0.8) + 1
            children.append(_Branch(points[k], heading, caliber, left))
    return points[:length], children
