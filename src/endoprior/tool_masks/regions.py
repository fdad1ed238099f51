"""Regions of an image that can be tools: large enough, and sure or entering end first from the border of the view."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SURE, POSSIBLE = 0.5, 0.35
"""Thresholds of the tool probability: a pixel on its own, and a pixel next to such pixels (hysteresis)."""
NEAR_PX = 4
"""A possible pixel counts within this distance of a sure one."""
SURE_REGION = 0.85
"""Mean probability from which on a region is a tool though it does not enter end first: gauze along the border, a
needle, the head of an instrument whose shaft is hidden."""
REACH = 0.75
"""A tool enters end first: it must reach into the view by this share of the length of its contact with the border.
At 0.5 an organ along the border passes; at 1 a thick shaft that has just entered fails."""
LEAST_SHARE = 0.002
"""Smaller regions, as a share of the view, are removed: about 25 px square at 640x512."""
LARGEST_HOLE = 0.01
"""Holes up to this share of the view are filled: highlights, and the windows of a grasper's jaws."""


def tool_regions(probability: NDArray[np.float32], view: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) True on the tools, from the probability (h, w), 0..1, of each pixel, and the view (h, w)."""
    smooth = cv2.GaussianBlur(probability, (0, 0), 0.8)
    sure = cv2.morphologyEx((smooth > SURE).astype(np.uint8), cv2.MORPH_OPEN, disk(1))
    possible = (smooth > POSSIBLE) & (cv2.dilate(sure, disk(NEAR_PX)) > 0)
    mask = filled((sure > 0) | possible, LARGEST_HOLE * view.sum()) & view
    return entering_regions(mask.astype(np.uint8), view) | sure_regions(mask.astype(np.uint8), smooth, view)


def sure_regions(
    mask: NDArray[np.uint8], probability: NDArray[np.float32], view: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(h, w) the regions of `mask` with a high mean `probability` (h, w), wherever they are."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    mean = np.bincount(label.ravel(), probability.ravel(), count) / stats[:, cv2.CC_STAT_AREA].clip(1)
    keep = (mean > SURE_REGION) & (stats[:, cv2.CC_STAT_AREA] >= LEAST_SHARE * view.sum())
    keep[0] = False
    return keep[label]


def entering_regions(mask: NDArray[np.uint8], view: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) the regions of `mask` that enter end first from the border of the view, as tools do."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    inward = cv2.distanceTransform(np.pad(view, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    keep = np.zeros(count, bool)
    for i in range(1, count):
        x, y, width, height, area = stats[i]
        box = np.s_[y : y + height, x : x + width]
        region = label[box] == i
        contact = region & (inward[box] <= 3)
        if area < LEAST_SHARE * view.sum() or not contact.any():
            continue
        # A tool that crosses the view touches the border twice; use the longer contact.
        pieces = cv2.connectedComponentsWithStats(contact.astype(np.uint8), connectivity=8)[2][1:]
        length = np.hypot(pieces[:, cv2.CC_STAT_WIDTH], pieces[:, cv2.CC_STAT_HEIGHT]).max()
        reach = cv2.distanceTransform((~contact).astype(np.uint8), cv2.DIST_L2, 5)[region].max()
        keep[i] = reach > REACH * length
    return keep[label]


def filled(mask: NDArray, most: float) -> NDArray[np.bool_]:
    """(h, w) `mask` with holes of at most that many pixels filled; tissue inside of a ring of gauze is no hole."""
    _, label, stats, _ = cv2.connectedComponentsWithStats((np.asarray(mask) == 0).astype(np.uint8), connectivity=4)
    x, y = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, low = x + stats[:, cv2.CC_STAT_WIDTH], y + stats[:, cv2.CC_STAT_HEIGHT]
    inner = (x > 0) & (y > 0) & (right < label.shape[1]) & (low < label.shape[0])
    hole = inner & (stats[:, cv2.CC_STAT_AREA] <= most)
    hole[0] = False
    return (np.asarray(mask) > 0) | hole[label]


def disk(radius: int) -> NDArray[np.uint8]:
    """Structuring element of that radius, px."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
