"""Scores of tool masks against true ones. Pure functions.

Shared letters: `H, W` image size. Masks are (H, W), True on tools; `counted` is True on the pixels that count.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ..footage.border import find_outline
from ..footage.overlays import LEAST_PX, find_static_overlays
from .score import Score

TOLERANCE = 0.0075
"""Distance up to which outlines agree, as a share of the image diagonal (Csurka et al., BMVC 2013)."""
TIP = 0.9
"""A tip begins at this share of the tool's length."""
LEAST_TEXT = 0.3
"""A masked region is the panel of a label, not a tool, if text or painted boxes are at least this share of it."""
CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Rows and columns to half of a pixel's eight neighbors; the other half are the same steps back."""
Mask = NDArray[np.bool_]


def _score(name: str, label: str, higher: bool, description: str, hint: str) -> Score:
    return Score(name, label, "", higher, 4, description, group="masks", hint=hint)


SCORES = (
    _score("mask_iou", "IoU", True, "Pixels that both masks mark, over those that either marks.", "1 is identical"),
    _score(
        "missed_area",
        "missed area",
        False,
        "True tool pixels that are not marked, over the true tool pixels.",
        "tool that becomes tissue",
    ),
    _score(
        "false_area",
        "false area",
        False,
        "Marked pixels that are no tool, over the true tool pixels, in frames that show a tool.",
        "tissue lost around tools",
    ),
    _score(
        "false_share_of_view",
        "false, no tool",
        False,
        "Marked pixels over the pixels that count, in frames that show no tool.",
        "share of frames without a tool",
    ),
    _score(
        "boundary_f1",
        "boundary F1",
        True,
        "Outline pixels within 0.75 % of the image diagonal of the other outline: F1 of precision and recall.",
        "1: outlines agree",
    ),
    _score(
        "missed_tips",
        "missed tips",
        False,
        "True pixels of the last 10 % of each tool's length that are not marked, over all such pixels.",
        "the end that touches tissue",
    ),
)
NO_VALUE = {
    "mask_iou": "neither mask marks a tool",
    "missed_area": "no scored frame shows a tool",
    "false_area": "no scored frame shows a tool",
    "false_share_of_view": "every scored frame shows a tool",
    "boundary_f1": "neither mask has an outline",
    "missed_tips": "no tool reaches into the image from its edge",
}
"""Why a score has no value."""


def count(found: Mask, truth: Mask, counted: Mask) -> Counter[str]:
    """Compare the mask of one frame with the true one. Counts of several frames can be added.

    Args:
        found, truth, counted: (H, W).
    Returns:
        Numbers of pixels: true tools (`tool`), their outline and tips (`true_outline`, `tip`), `outline` of what is
        marked; `_hit`, those of them that are marked, or outlines near the other one; `false_beside_tool` and
        `false_without_tool`, marked, but no tool, in frames that show one and in others; `view_without_tool`, all that
        count in the others.
    """
    found, truth = found & counted, truth & counted
    outline, true_outline, tip = boundary(found, counted), boundary(truth, counted), tips(truth, counted)
    pixels = {
        "tool": truth,
        "hit": found & truth,
        "outline": outline,
        "outline_hit": outline & near(true_outline),
        "true_outline": true_outline,
        "true_outline_hit": true_outline & near(outline),
        "tip": tip,
        "tip_hit": tip & found,
    }
    if truth.any():
        pixels["false_beside_tool"] = found & ~truth
    else:
        pixels |= {"false_without_tool": found, "view_without_tool": counted}
    return Counter({name: int(mask.sum()) for name, mask in pixels.items()})


def scores_of(pixels: Counter[str]) -> dict[str, float]:
    """The value of each of `SCORES` by `count`; NaN where there is none (`NO_VALUE`)."""
    tool, beside, without = (pixels[name] for name in ("tool", "false_beside_tool", "false_without_tool"))
    precision = pixels["outline_hit"] / max(pixels["outline"], 1)
    recall = pixels["true_outline_hit"] / max(pixels["true_outline"], 1)
    f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return {
        "mask_iou": _ratio(pixels["hit"], tool + beside + without),
        "missed_area": _ratio(tool - pixels["hit"], tool),
        "false_area": _ratio(beside, tool),
        "false_share_of_view": _ratio(without, pixels["view_without_tool"]),
        "boundary_f1": f1 if pixels["outline"] or pixels["true_outline"] else float("nan"),
        "missed_tips": _ratio(pixels["tip"] - pixels["tip_hit"], pixels["tip"]),
    }


def counted_pixels(images: Sequence[NDArray[np.uint8]], always_masked: Mask) -> Mask:
    """(H, W) True on the pixels that count: all but the border around the endoscope image and burned-in labels.

    A pixel is left out if both hold:
    - the masks, or the true masks, mark it in every frame. One of them is enough: prepared masks hold the border, and
      most true masks do not;
    - the images show nothing of the body there. It lies in a strip at a side or outside of a round border
      (`footage.border.find_outline`), or on a label with its panel, which is burned-in text (`footage.overlays`) or
      a rectangle that `prepare --blank` painted, or it is exactly black in all images.

    So a tool that is static in the whole clip counts. A dark shaft does, too: a camera's black has noise. Pixels
    within `TOLERANCE` of those left out do not count either: masks of one border differ by a few pixels.

    Args:
        images: (H, W, 3) samples of the whole clip.
        always_masked: (H, W) True where the masks, or the true masks, mark every frame.
    """
    outline = find_outline(images)
    black = ~np.maximum.reduce(images).any(-1)
    border = outline.in_strip | outline.outside | black
    return ~near(always_masked & (border | _labels(images, black, always_masked)))


def _labels(images: Sequence[NDArray[np.uint8]], black: Mask, always_masked: Mask) -> Mask:
    """(H, W) True on burned-in text, on painted rectangles, and on always masked regions that they cover largely."""
    boxes = find_static_overlays(images)
    for *box, area in cv2.connectedComponentsWithStats(black.astype(np.uint8), connectivity=4)[2][1:].tolist():
        if area == box[2] * box[3] and min(box[2:]) >= LEAST_PX:  # a dark tool has another shape
            boxes.append(tuple(box))
    text = np.zeros_like(always_masked)
    for x, y, width, height in boxes:
        text[y : y + height, x : x + width] = True
    total, regions = cv2.connectedComponents(always_masked.astype(np.uint8), connectivity=4)
    pixels, of_text = (np.bincount(part, minlength=total) for part in (regions.ravel(), regions[text]))
    panels = (of_text >= LEAST_TEXT * pixels)[regions]
    return text | (panels & always_masked)


def boundary(mask: Mask, counted: Mask) -> Mask:
    """(H, W) True on the mask's pixels with one of four neighbors that counts and is not in the mask.

    Edges of the image and of the pixels that count are no outline.
    """
    mask = mask & counted
    return mask & _grown(counted & ~mask)


def near(pixels: Mask) -> Mask:
    """(H, W) True within `TOLERANCE` of any of the pixels."""
    if not pixels.any():
        return np.zeros_like(pixels)
    distance = cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distance <= TOLERANCE * np.hypot(*pixels.shape)


def tips(truth: Mask, counted: Mask) -> Mask:
    """(H, W) True on the tips of tools: the last 10 % of their length, seen from where they enter the image.

    A tool is a region of `truth` (8 neighbors) in contact with the edge of the image, or with the border around it.
    The distance of a pixel is the length of the shortest path to the contact inside the region; the tip has at
    least 0.9 of the region's largest distance. Regions without contact have no tip. Tools that touch are one region.
    """
    truth = truth & counted
    distance = _distance_from_entry(truth, truth & _grown(_outside(counted))[1:-1, 1:-1])
    _, regions = cv2.connectedComponents(truth.astype(np.uint8), connectivity=8)
    reached = np.isfinite(distance)
    farthest = np.zeros(int(regions.max()) + 1)
    np.maximum.at(farthest, regions[reached], distance[reached])
    length = farthest[regions]
    return reached & (length > 0) & (distance >= TIP * length)


def _outside(counted: Mask) -> Mask:
    """(H + 2, W + 2) a rim around the image, and the pixels that do not count and hang together with it."""
    nothing = np.pad(~counted, 1, constant_values=True)
    _, parts = cv2.connectedComponents(nothing.astype(np.uint8), connectivity=4)
    return parts == parts[0, 0]


def _grown(mask: Mask) -> Mask:
    """The mask with its four neighbors."""
    return cv2.dilate(mask.astype(np.uint8), CROSS) > 0


def _distance_from_entry(region: Mask, entry: Mask) -> NDArray[np.float64]:
    """(H, W) length of the shortest path in `region` to a pixel of `entry`, px; infinite where there is none."""
    distance = np.full(region.shape, np.inf)
    if not entry.any():
        return distance
    number = np.full(np.add(region.shape, 2), -1)
    inner = number[1:-1, 1:-1]
    inner[region] = np.arange(region.sum())
    starts, ends, lengths = [], [], []
    for down, right in STEPS:
        neighbor = np.roll(number, (-down, -right), (0, 1))[1:-1, 1:-1]
        both = region & (neighbor >= 0)
        starts.append(inner[both])
        ends.append(neighbor[both])
        lengths.append(np.full(int(both.sum()), np.hypot(down, right)))
    places = np.concatenate(starts), np.concatenate(ends)
    graph = coo_array((np.concatenate(lengths), places), shape=(int(region.sum()),) * 2).tocsr()
    distance[region] = dijkstra(graph, directed=False, indices=inner[entry], min_only=True)
    return distance


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
