"""Regions of an image that can be tools: large enough, and sure or entering end first from the border of the view."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..footage.components import AREA, HEIGHT, LEFT, TOP, WIDTH, Mask, components, disk, grown, regions_where

SURE, POSSIBLE = 0.5, 0.35
"""Thresholds of the tool probability: a pixel on its own, and a pixel next to such pixels (hysteresis)."""
NEAR_PX = 4  # A possible pixel counts within this distance of a sure one
SURE_REGION = 0.85
"""Mean probability from which on a region is a tool though it does not enter end first: gauze along the border, a
needle, the head of an instrument whose shaft is hidden."""
REACH = 0.75
"""A tool enters end first: it must reach into the view by this share of the length of its contact with the border.
At 0.5 an organ along the border passes; at 1 a thick shaft that has just entered fails."""
LEAST_SHARE = 0.002  # Smaller regions, as a share of the view, are removed: about 25 px square at 640x512
LARGEST_HOLE = 0.01  # Holes up to this share of the view are filled: highlights, and the windows of a grasper's jaws


def tool_regions(probability: NDArray[np.floating], view: Mask) -> Mask:
    """(h, w) True on the tools, from the probability (h, w), 0..1, of each pixel, and the view (h, w)."""
    smooth = np.asarray(cv2.GaussianBlur(probability, (0, 0), 0.8))
    sure = cv2.morphologyEx((smooth > SURE).astype(np.uint8), cv2.MORPH_OPEN, disk(1)) > 0
    possible = (smooth > POSSIBLE) & grown(sure, disk(NEAR_PX))
    mask = filled(sure | possible, LARGEST_HOLE * view.sum()) & view
    labels, boxes = components(mask)
    mean = np.bincount(labels.ravel(), smooth.ravel(), len(boxes)) / boxes[:, AREA].clip(1)
    certain = (mean > SURE_REGION) & (boxes[:, AREA] >= LEAST_SHARE * view.sum())
    return entering_regions(mask, view) | regions_where(certain, labels)


def entering_regions(mask: NDArray, view: Mask) -> Mask:
    """(h, w) the regions of `mask` that enter end first from the border of the view, as tools do."""
    labels, boxes = components(mask)
    inward = cv2.distanceTransform(np.pad(view, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    keep = np.zeros(len(boxes), bool)
    for i, (x, y, width, height, area) in enumerate(boxes):
        box = np.s_[y : y + height, x : x + width]
        region = labels[box] == i
        contact = region & (inward[box] <= 3)
        if i == 0 or area < LEAST_SHARE * view.sum() or not contact.any():
            continue
        # A tool that crosses the view touches the border twice; use the longer contact.
        pieces = components(contact)[1][1:]
        length = np.hypot(pieces[:, WIDTH], pieces[:, HEIGHT]).max()
        reach = cv2.distanceTransform((~contact).astype(np.uint8), cv2.DIST_L2, 5)[region].max()
        keep[i] = reach > REACH * length
    return regions_where(keep, labels)


def filled(mask: NDArray, most: float) -> Mask:
    """(h, w) `mask` with holes of at most that many pixels filled; tissue inside of a ring of gauze is no hole."""
    mask = np.asarray(mask) > 0
    labels, boxes = components(~mask, 4)
    x, y, width, height = (boxes[:, column] for column in (LEFT, TOP, WIDTH, HEIGHT))
    inner = (x > 0) & (y > 0) & (x + width < mask.shape[1]) & (y + height < mask.shape[0])
    return mask | regions_where(inner & (boxes[:, AREA] <= most), labels)
