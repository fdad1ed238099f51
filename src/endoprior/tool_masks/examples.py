"""Examples of tool and tissue from one click, and the classifier that they give.

A click grows to the region around it that is most stable: whose outline changes least when a larger difference from
the clicked color is allowed (Matas et al., BMVC 2002). Its pixels are examples of the tool. What the masks call tissue
is tissue, except for what looks like the clicked tool: the same tool is missed in other frames, too.

`h, w` is the size of the network's image, `k` the number of features, `n` of examples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import spread
from .feature_maps import LOOK
from .logistic import fit_logistic, probability
from .regions import disk

LARGEST_REGION = 0.08
"""Largest region of one click, as a share of the view: larger ones have run over tissue."""
LEAST_REGION_PX = 20
"""Smaller regions are not compared: their outlines are rough."""
FARTHEST, NUM_THRESHOLDS = 2.5, 60
"""Largest difference from the click, in standard deviations of the frame, and number of differences that are tried."""
STEPS_BESIDE = 3
"""A region is stable if it grows little from so many thresholds below to so many above."""
LARGER_IS_BETTER = 0.03
"""Of two equally stable regions the larger one is taken: weight of the logarithm of the area."""
GAP_PX = 2
"""Pixels this near to a tool are not examples of tissue: they are mixed."""
TISSUE, TISSUE_IN_CLICKED, TOOL = 400, 1600, 200
"""Examples of one frame: of tissue, of tissue in the frame of the click, and of tools that are masked already."""
CLICKED_WEIGHT, CLICKED_MOST, TOOL_WEIGHT = 0.5, 300.0, 0.3
"""Weight of a clicked pixel, of all of them together at most, and of a pixel that is masked already. Tissue weighs 1:
to take tissue for a tool is worse than to miss a part, which another click finds."""
LOOKS_CLICKED = 0.7
"""Tissue of a higher probability is no example: it is likely the clicked tool in another frame."""
ROUNDS = 2
RIDGE = 1.0
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Examples:
    """Pixels that are known."""

    features: NDArray[np.float32]
    """(n, k)."""
    is_tool: NDArray[np.bool_]
    """(n,)."""
    weight: NDArray[np.float64]
    """(n,)."""


@dataclass(frozen=True)
class Classifier:
    """Log-odds of a tool from the features of a pixel."""

    mean: NDArray[np.float64]
    """(k,)."""
    scale: NDArray[np.float64]
    """(k,)."""
    coefficients: NDArray[np.float64]
    """(k + 1,) of normalized features, and a constant."""

    def log_odds(self, features: NDArray[np.float32]) -> NDArray[np.float64]:
        """(...) from features (..., k): those of the network, the first feature, and what the examples add."""
        return features[..., 0] + self._normal(features) @ self.coefficients[:-1] + self.coefficients[-1]

    def _normal(self, features: NDArray[np.float32]) -> NDArray[np.float64]:
        return (features - self.mean) / self.scale


def clicked_region(features: NDArray[np.float32], free: Mask, spot: tuple[int, int]) -> Mask:
    """(h, w) the region of one look around a click.

    Args:
        features: (h, w, k) of `feature_map`.
        free: (h, w) True where the region can be: in the view, and not on tools that are known.
        spot: (column, row) of the click, in `free`.
    Raises:
        ValueError: the spot is not in `free`.
    """
    x, y = spot
    if not free[y, x]:
        raise ValueError(f"spot must be where the region can be; got {spot}")
    look = features[..., LOOK]
    scale = look[free].std(0) + 1e-6
    seed = np.zeros_like(free)
    seed[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2] = True
    seed &= free
    difference = np.sqrt((((look - look[seed].mean(0)) / scale) ** 2).mean(-1))
    difference = cv2.GaussianBlur(difference.astype(np.float32), (0, 0), 0.8)
    regions: list[Mask] = []
    for most in np.linspace(difference[y, x] + 0.02, FARTHEST, NUM_THRESHOLDS):
        _, label = cv2.connectedComponents((((difference <= most) & free) | seed).astype(np.uint8), connectivity=4)
        region = label == label[y, x]
        if region.sum() > LARGEST_REGION * free.sum():
            break
        regions.append(region)
    return regions[_most_stable(np.array([region.sum() for region in regions]))] if regions else seed


def _most_stable(areas: NDArray) -> int:
    """Index of the region that grows least, by the areas of regions of growing thresholds."""
    at = np.arange(len(areas))
    above, below = np.minimum(at + STEPS_BESIDE, len(areas) - 1), np.maximum(at - STEPS_BESIDE, 0)
    log = np.log(areas)
    growth = (log[above] - log[below]) / np.maximum(above - below, 1) - LARGER_IS_BETTER * log
    large = areas >= LEAST_REGION_PX
    return int(np.where(large, growth, np.inf).argmin()) if large.any() else len(areas) - 1


def examples_of(features: NDArray[np.float32], view: Mask, tool: Mask, clicked: Mask) -> Examples:
    """The examples of one frame.

    Args:
        features: (h, w, k).
        view: (h, w) True inside the endoscope's image.
        tool: (h, w) True on tools that are masked already.
        clicked: (h, w) True on the regions of clicks; all False in most frames.
    """
    near = cv2.dilate((tool | clicked).astype(np.uint8), disk(GAP_PX)) > 0
    some_clicked, total = clicked.any(), max(float(clicked.sum()), 1.0)
    parts = (
        (clicked, int(total), True, min(CLICKED_WEIGHT, CLICKED_MOST / total)),
        (tool & ~clicked & view, TOOL, True, TOOL_WEIGHT),
        (view & ~near, TISSUE_IN_CLICKED if some_clicked else TISSUE, False, 1.0),
    )
    rows = [_evenly(features[where], most) for where, most, _, _ in parts]
    counts = [len(row) for row in rows]
    return Examples(
        np.concatenate(rows),
        np.repeat([is_tool for _, _, is_tool, _ in parts], counts),
        np.repeat([weight for *_, weight in parts], counts),
    )


def fit(frames: Sequence[Examples]) -> Classifier:
    """Fit a classifier to the examples of some frames.

    Tissue that looks like a tool after the first round is left out of the second.
    """
    features = np.concatenate([each.features for each in frames])
    is_tool = np.concatenate([each.is_tool for each in frames])
    weight = np.concatenate([each.weight for each in frames])
    mean, scale = features.mean(0, dtype=np.float64), features.std(0, dtype=np.float64) + 1e-3
    kept = np.ones(len(features), bool)
    for _ in range(ROUNDS):
        normal = (features[kept] - mean) / scale
        offset = features[kept, 0].astype(np.float64)
        classifier = Classifier(mean, scale, fit_logistic(normal, is_tool[kept], weight[kept], offset, RIDGE))
        kept = is_tool | (probability(classifier.log_odds(features)) < LOOKS_CLICKED)
    return classifier


def _evenly(rows: NDArray, most: int) -> NDArray:
    """At most so many rows, spread evenly."""
    return rows[spread(len(rows), most)] if len(rows) > most else rows
