"""Edges of a mask moved to where the image changes, to a fraction of a px. Pixel coordinates as in `shaft_edges`.

Masks of tools are often a few px too wide. Near a line of the mask, the line is taken along which the colors change
most, all places along it counting alike.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

INWARD_PX, OUTWARD_PX = 14.0, 4.0  # how far from the line of the mask to look, at a width of 640 px
SAMPLE_PX = 0.5  # between samples across the edge
BLUR_PX = 1.5
COLOR_SHARE_OFFSET = 8  # added to each channel, of 255: the colors of dark pixels are noise
NEAR_PX = 1.5  # of edge points around their line
STRONG = 80.0  # percentile of the changes around a line that counts as much as any stronger change
MIN_EDGE_SHARE = 0.5  # of the places along an edge that must change near the line


def image_edge(
    smooth: NDArray[np.float32], ends: tuple[NDArray, NDArray], inside: NDArray
) -> tuple[NDArray, tuple[NDArray, NDArray]] | None:
    """The line (3,), as in `shaft_edges`, along which an image changes most near a line; and its two ends (2,).

    Args:
        smooth: (H, W, 3) blurred image.
        ends: (2,) x, y of the ends of that line, px.
        inside: (2,) x, y of a place on the side of the tool.
    Returns:
        None if the changes are not on one line.
    """
    scale = max(smooth.shape[1] / 640, 1.0)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    along = (ends[1] - ends[0]) / max(length, 1e-9)
    outward = -np.array([-along[1], along[0]]) * np.sign(
        along[0] * (inside - ends[0])[1] - along[1] * (inside - ends[0])[0]
    )
    places = np.arange(0.0, length + 0.5)
    across = np.arange(-INWARD_PX * scale, OUTWARD_PX * scale + SAMPLE_PX / 2, SAMPLE_PX)
    at = ends[0] + places[:, None, None] * along + across[None, :, None] * outward
    profile = _sampled(smooth, at)
    change = np.abs(np.gradient(profile, SAMPLE_PX, axis=1)).sum(-1)
    change[~((at >= 1) & (at < (smooth.shape[1] - 1, smooth.shape[0] - 1))).all(-1)] = 0
    first, last = _strongest(np.minimum(change, np.percentile(change, STRONG)))
    fit = np.array([(across[last] - across[first]) / max(places[-1], 1.0), across[first]])
    near_line = np.abs(across - np.polyval(fit, places)[:, None]) <= NEAR_PX * scale
    best = np.where(near_line, change, 0).argmax(1)
    there = (change * near_line).max(1) > np.median(change)
    if there.sum() < max(MIN_EDGE_SHARE * len(places), 8):
        return None
    offset = across[best] + SAMPLE_PX * _peak(change, best)
    points = (ends[0] + places[:, None] * along + offset[:, None] * outward)[there].astype(np.float32)
    dx, dy, x, y = cv2.fitLine(points, cv2.DIST_HUBER, 0, 0.01, 0.01).ravel().astype(np.float64)
    found = np.array([-dy, dx, dy * x - dx * y])
    ends = (ends[0] - (found @ [*ends[0], 1.0]) * found[:2], ends[1] - (found @ [*ends[1], 1.0]) * found[:2])
    return found, ends


def smoothed(rgb_u8: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H, W, 3) shares of red, green and blue without their noise, for `image_edge`: light and shadow do not count."""
    sigma = BLUR_PX * max(rgb_u8.shape[1] / 640, 1.0)
    smooth = np.asarray(cv2.GaussianBlur(rgb_u8.astype(np.float32), (0, 0), sigma), np.float32) + COLOR_SHARE_OFFSET
    return smooth / smooth.sum(-1, keepdims=True)


def _strongest(change: NDArray) -> tuple[int, int]:
    """The columns at the first and the last row of (N, S) between which the line with the largest sum runs."""
    count, samples = change.shape
    share = np.linspace(0, 1, count)
    rows = np.arange(count)
    columns = np.arange(samples)
    best, found = -1.0, (0, 0)
    for first in columns:
        paths = np.rint(first + share[:, None] * (columns - first)).astype(np.intp)
        totals = change[rows[:, None], paths].sum(0)
        last = int(totals.argmax())
        if totals[last] > best:
            best, found = float(totals[last]), (int(first), last)
    return found


def _sampled(image: NDArray[np.float32], at: NDArray) -> NDArray[np.float32]:
    """(N, S, 3) colors at (N, S, 2) x, y; OpenCV counts pixel centers from 0."""
    x, y = (at[..., axis].astype(np.float32) - np.float32(0.5) for axis in (0, 1))
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _peak(change: NDArray, best: NDArray) -> NDArray:
    """(N,) where a parabola through the largest value of each row and its neighbors peaks, in samples from it."""
    rows = np.arange(len(change))
    inner = np.clip(best, 1, change.shape[1] - 2)
    before, here, after = (change[rows, inner + step] for step in (-1, 0, 1))
    bend = before - 2 * here + after
    return np.clip(np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend < 0), -1, 1)
