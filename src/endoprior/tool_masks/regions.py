"""Regions of an image that can be tools: with an outline that the network is sure of, and sure or entering end first.

A tool may touch what the network only half takes for one: a dark corner, smoke. The level of the log-odds at which a
region ends is therefore its own: the lowest from which the next one hardly makes it smaller (a maximally stable
extremal region, Matas et al. 2002). What shrinks with every level has no outline, and is no tool.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..footage.image_operations import AREA, HEIGHT, LEFT, TOP, WIDTH, Mask, components, dilated, disk, regions_where

LEVELS = np.arange(-0.6, 4.01, 0.5)  # of the log-odds, at which regions may end: probabilities from 0.35 to 0.98
STABLE = 0.8  # Share of a region that the next level leaves of one with an outline
SURE_REGION = 0.8
"""Mean probability from which on a region is a tool though it does not enter end first: gauze along the border, a
needle, the head of an instrument whose shaft is hidden."""
REACH = 0.75
"""A tool enters end first: it must reach into the view by this share of the length of its contact with the border.
At 0.5 an organ along the border passes; at 1 a thick shaft that has just entered fails."""
MIN_TOOL_REGION_SHARE = 0.002  # Smaller regions, as a share of the view, are removed: about 25 px square at 640x512
MAX_HOLE = 0.01  # Holes up to this share of the view are filled: highlights, and the windows of a grasper's jaws
RIM_PX = 2  # Pixels this near to a tool belong to it from the first level on
OUTSIDE = -8.0  # Log-odds beyond the view


@dataclass(frozen=True)
class Region:
    """A region with an outline of its own."""

    mask: Mask  # (h, w)
    is_tool: bool  # by this image alone


def tool_regions(log_odds: NDArray[np.float32], view: Mask) -> Mask:
    """(h, w) True on the tools, from the log-odds (h, w) of each pixel, and the view (h, w)."""
    found = candidate_regions(log_odds, view)
    return joined([region.mask for region in found if region.is_tool], log_odds, view)


def candidate_regions(log_odds: NDArray[np.float32], view: Mask) -> list[Region]:
    """All regions with an outline; arguments as in `tool_regions`. In one that is no tool, smaller ones may be."""
    smooth, least, most = _smooth(log_odds, view), MIN_TOOL_REGION_SHARE * view.sum(), MAX_HOLE * view.sum()
    probability = 1 / (1 + np.exp(-smooth))

    def regions(mask: Mask, level: int) -> list[Region]:
        """Those inside of the parts of a mask, which ends at this level."""
        labels, boxes = components(mask)
        return [
            region
            for i in range(1, len(boxes))
            if boxes[i, AREA] >= least
            for region in regions_of_part(labels == i, level)
        ]

    def regions_of_part(part: Mask, level: int) -> list[Region]:
        is_last = level + 1 == len(LEVELS)
        higher = np.zeros_like(part) if is_last else _opened(part & (smooth > LEVELS[level + 1]))
        if not is_last and np.count_nonzero(higher) < STABLE * np.count_nonzero(part):
            return regions(higher, level + 1)
        whole = filled(part, most) & view
        if probability[whole].mean() > SURE_REGION or entering_regions(whole, view).any():
            return [Region(whole, True)]
        inner = [region for region in regions(higher, level + 1) if region.is_tool]
        return inner or [Region(whole, False)]

    return regions(filled(_opened(smooth > LEVELS[0]), most) & view, 0)


def joined(masks: list[Mask], log_odds: NDArray[np.float32], view: Mask) -> Mask:
    """(h, w) the union of regions, with their rims."""
    union = np.any([np.zeros_like(view), *masks], axis=0)
    rim = (_smooth(log_odds, view) > LEVELS[0]) & dilated(union, disk(RIM_PX))
    return filled(union | rim, MAX_HOLE * view.sum()) & view


def _smooth(log_odds: NDArray[np.float32], view: Mask) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(np.where(view, log_odds, np.float32(OUTSIDE)), (0, 0), 0.8), np.float32)


def _opened(mask: Mask) -> Mask:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disk(1)) > 0


def entering_regions(mask: NDArray, view: Mask) -> Mask:
    """(h, w) the regions of `mask` that enter end first from the border of the view, as tools do."""
    labels, boxes = components(mask)
    inward = cv2.distanceTransform(np.pad(view, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    keep = np.zeros(len(boxes), bool)
    for i, (x, y, width, height, area) in enumerate(boxes):
        box = np.s_[y : y + height, x : x + width]
        region = labels[box] == i
        contact = region & (inward[box] <= 3)
        if i == 0 or area < MIN_TOOL_REGION_SHARE * view.sum() or not contact.any():
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
