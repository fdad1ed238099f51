"""Which colors of a clip move with their surroundings: those are tissue, however pale they are.

Neighboring tissue moves alike, whether the camera moves or the patient breathes. A tool is held by somebody else: it
moves unlike the tissue behind it. A single pair of frames says little, because a tool may rest. So the evidence of all
pairs is collected by color: a gallbladder that follows the liver in twenty pairs of frames is no tool.

`h, w` size of the resized image.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ..footage.optical_flow import flow_between
from .colors import ClipColors, log_ratios

BINS = (32, 24, 6)
"""Cells of the color table along log(red / green), log(blue / green) and the root of brightness."""
LOW, HIGH = np.array([-0.3, -0.9, 0.0]), np.array([1.2, 0.6, 1.0])
SURELY_TISSUE = -0.85
"""Log-odds of the first guess below which a pixel counts for the motion of the surroundings: a probability of 0.3."""
SURROUNDINGS_PX = 40
"""Standard deviation of the window that gives the motion of the surroundings, px: wider than a tool."""
LEAST_MOTION_PX = 2.0
"""Sum of a pixel's own motion and that of its surroundings below which they say nothing."""
TYPICAL = 0.35
"""Difference of the two motions, as a share of their sum, that speaks neither for tissue nor for a tool. Attached
tissue has 0.05 to 0.2 even with parallax, tools 0.5 to 1."""
GAIN = 10.0
"""Log-odds per unit of this share."""
LEAST, MOST = -3.0, 2.0
"""Limits of the log-odds: tissue that a grasper pulls also moves unlike its surroundings."""
ENOUGH = 0.05
"""Share of all pixels that has to move for the evidence to have its full weight."""


def color_cells(rgb_u8: NDArray[np.uint8], clip: ClipColors) -> NDArray[np.int32]:
    """(h, w) cell of the color table of each pixel of `rgb_u8` (h, w, 3)."""
    color = cv2.GaussianBlur(rgb_u8, (0, 0), 1.0).astype(np.float32) / np.float32(clip.white)
    cell = np.zeros(color.shape[:2], np.int32)
    for axis, value in enumerate((*log_ratios(color), np.sqrt(color.max(-1)))):
        position = (value - LOW[axis]) / (HIGH[axis] - LOW[axis]) * BINS[axis]
        cell = cell * BINS[axis] + np.clip(position, 0, BINS[axis] - 1).astype(np.int32)
    return cell


def independence(
    rgb_u8: NDArray[np.uint8],
    later_u8: NDArray[np.uint8],
    view: NDArray[np.bool_],
    guess: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """How much each pixel moves unlike its surroundings from one frame to a later one.

    Args:
        rgb_u8, later_u8: (h, w, 3), 0..255.
        view: (h, w) True inside the endoscope's image.
        guess: (h, w) log-odds of a tool.
    Returns:
        (h, w) difference of the two motions over their sum, 0 (attached) to 1; (h, w) True where it says anything.
    """
    gray, later = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (rgb_u8, later_u8))
    flow = flow_between(gray, later)
    weight = ((guess < SURELY_TISSUE) & view).astype(np.float32) + np.float32(1e-4) * view
    total = cv2.GaussianBlur(flow * weight[..., None], (0, 0), SURROUNDINGS_PX)
    around = total / np.maximum(cv2.GaussianBlur(weight, (0, 0), SURROUNDINGS_PX), 1e-6)[..., None]
    own_px, around_px, apart_px = (np.hypot(x[..., 0], x[..., 1]) for x in (flow, around, flow - around))
    return apart_px / (own_px + around_px + np.float32(0.5)), (own_px + around_px > LEAST_MOTION_PX) & view


def attachment_log_odds(
    evidence: Iterable[tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.bool_]]], num_pixels: int
) -> NDArray[np.float32]:
    """Log-odds of a tool for each color cell, from motion alone.

    Args:
        evidence: for each pair of frames the color cells, and the two results of `independence`.
        num_pixels: number of pixels inside the view in all frames together.
    Returns:
        (cells,), in [-3, 2]; 0 where nothing moved.
    """
    total, count = np.zeros((2, int(np.prod(BINS))))
    for cell, apart, moving in evidence:
        total += np.bincount(cell[moving], apart[moving], total.size)
        count += np.bincount(cell[moving], minlength=total.size)
    total, count = (gaussian_filter(x.reshape(BINS), (0.7, 0.7, 0.5)).ravel() for x in (total, count))
    few = 2e-5 * max(count.sum(), 1.0)
    share = (total + few * TYPICAL) / (count + few)
    trust = count / (count + few) * min(1.0, count.sum() / (ENOUGH * max(num_pixels, 1)))
    return (np.clip(GAIN * (share - TYPICAL), LEAST, MOST) * trust).astype(np.float32)
