"""Examples of tool and tissue from one click, and the classifier that they give.

What tells a clicked tool from tissue are the network's log-odds, color and local contrast of each pixel. (Features of
the network's decoder do no better on tools that it misses.) A click grows to the region around it that is most stable:
whose outline changes least when a larger difference from the clicked color is allowed (Matas et al., BMVC 2002). Its
pixels are examples of the tool. What the masks call tissue is tissue, except for what looks like the clicked tool: the
same tool is missed in other frames, too.

`h, w` is the size of the network's image, `k` the number of features, `n` of examples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import evenly_spaced
from ..footage.image_operations import Mask, components, dilated, disk

SURE = 4.0  # Log-odds count up to this, so that examples can outweigh a network that is sure and wrong
COLORS = 5  # Channels of the network's image: color, two color ratios
SMOOTH_PX, CONTRAST_PX = 1.0, 2.0  # Standard deviations of the windows of color and contrast
MIN_CONTRAST = 0.02  # Added before the logarithm: about the noise of a color of [-1, 1]
APPEARANCE = slice(0, 1 + COLORS)
"""The features by which a region of one tool is told from what is beside it: all but the contrast."""
MAX_REGION = 0.08  # Largest region of one click, as a share of the view: larger ones have run over tissue
MIN_REGION_PX = 20  # Smaller regions are not compared: their outlines are rough
FARTHEST, NUM_THRESHOLDS = 2.5, 60
"""Largest difference from the click, in standard deviations of the frame, and number of differences that are tried."""
STEPS_BESIDE = 3  # A region is stable if it grows little from so many thresholds below to so many above
LARGER_IS_BETTER = 0.03  # Of two equally stable regions the larger one: weight of the logarithm of the area
GAP_PX = 2  # Pixels this near to a tool are not examples of tissue: they are mixed
TISSUE, TISSUE_IN_CLICKED, TOOL = 400, 1600, 200
"""Examples of one frame: of tissue, of tissue in the frame of the click, and of tools that are masked already."""
CLICKED_WEIGHT, CLICKED_MOST, TOOL_WEIGHT = 0.5, 300.0, 0.3
"""Weight of a clicked pixel, of all of them together at most, and of a pixel that is masked already. Tissue weighs 1:
to take tissue for a tool is worse than to miss a part, which another click finds."""
MAX_TISSUE_PROBABILITY = 0.7  # Tissue above it is no example: it is likely the clicked tool in another frame
ROUNDS = 2
RIDGE = 1.0
MAX_STEPS = 20
MIN_STEP = 1e-3  # A Newton step is halved until the loss falls; below this share of it the fit is done
SMALL_GAIN = 1e-3  # The fit is done when a step lowers the loss by less


@dataclass(frozen=True)
class Examples:
    """Pixels that are known."""

    features: NDArray[np.float32]  # (n, k)
    is_tool: Mask  # (n,)
    weight: NDArray[np.float64]  # (n,)


@dataclass(frozen=True)
class Classifier:
    """Log-odds of a tool from the features of a pixel."""

    mean: NDArray[np.float64]  # (k,)
    scale: NDArray[np.float64]  # (k,)
    coefficients: NDArray[np.float64]  # (k + 1,) of normalized features, and a constant

    def log_odds(self, features: NDArray[np.float32]) -> NDArray[np.float64]:
        """(...) from features (..., k): those of the network, the first feature, and what the examples add."""
        normal = (features - self.mean) / self.scale
        return features[..., 0] + normal @ self.coefficients[:-1] + self.coefficients[-1]


def feature_map(log_odds: NDArray[np.float32], image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w, 7) clipped log-odds, smoothed color, log of the local contrast, of log-odds and `network_input`."""
    gray = image[:3].mean(0)
    mean, square = (cv2.GaussianBlur(each, (0, 0), CONTRAST_PX) for each in (gray, gray * gray))
    contrast = np.log(np.sqrt(np.maximum(square - mean * mean, 0)) + np.float32(MIN_CONTRAST))
    color = [cv2.GaussianBlur(channel, (0, 0), SMOOTH_PX) for channel in image[:COLORS]]
    return np.stack([np.clip(log_odds, -SURE, SURE), *color, contrast], -1).astype(np.float32)


def clicked_region(features: NDArray[np.float32], free: Mask, spot: tuple[int, int]) -> Mask:
    """(h, w) the region of one appearance around a click at (column, row), in the view beside known tools, `free`."""
    x, y = spot
    if not free[y, x]:
        raise ValueError(f"spot must be where the region can be; got {spot}")
    appearance = features[..., APPEARANCE]
    scale = appearance[free].std(0) + 1e-6
    seed = np.zeros_like(free)
    seed[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2] = True
    seed &= free
    difference = np.sqrt((((appearance - appearance[seed].mean(0)) / scale) ** 2).mean(-1))
    difference = cv2.GaussianBlur(difference.astype(np.float32), (0, 0), 0.8)
    regions: list[Mask] = []
    for most in np.linspace(difference[y, x] + 0.02, FARTHEST, NUM_THRESHOLDS):
        labels, _ = components(((difference <= most) & free) | seed, 4)
        region = labels == labels[y, x]
        if region.sum() > MAX_REGION * free.sum():
            break
        regions.append(region)
    return regions[_most_stable(np.array([region.sum() for region in regions]))] if regions else seed


def _most_stable(areas: NDArray) -> int:
    at = np.arange(len(areas))
    above, below = np.minimum(at + STEPS_BESIDE, len(areas) - 1), np.maximum(at - STEPS_BESIDE, 0)
    log = np.log(areas)
    growth = (log[above] - log[below]) / np.maximum(above - below, 1) - LARGER_IS_BETTER * log
    large = areas >= MIN_REGION_PX
    return int(np.where(large, growth, np.inf).argmin()) if large.any() else len(areas) - 1


def examples_of(features: NDArray[np.float32], view: Mask, tool: Mask, clicked: Mask) -> Examples:
    """The examples of one frame: `view` (h, w) is True inside the endoscope's image, `tool` on tools that are masked
    already, `clicked` on the regions of clicks; all False in most frames.
    """
    near = dilated(tool | clicked, disk(GAP_PX))
    some_clicked, total = clicked.any(), max(float(clicked.sum()), 1.0)
    parts = (
        (clicked, int(total), True, min(CLICKED_WEIGHT, CLICKED_MOST / total)),
        (tool & ~clicked & view, TOOL, True, TOOL_WEIGHT),
        (view & ~near, TISSUE_IN_CLICKED if some_clicked else TISSUE, False, 1.0),
    )
    rows = [features[where][evenly_spaced(int(where.sum()), most)] for where, most, _, _ in parts]
    counts = [len(row) for row in rows]
    return Examples(
        np.concatenate(rows),
        np.repeat([is_tool for _, _, is_tool, _ in parts], counts),
        np.repeat([weight for *_, weight in parts], counts),
    )


def fit(frames: Sequence[Examples]) -> Classifier:
    """Fit a classifier to examples, twice: tissue that looks like a tool after the first round is left out."""
    features = np.concatenate([each.features for each in frames])
    is_tool = np.concatenate([each.is_tool for each in frames])
    weight = np.concatenate([each.weight for each in frames])
    mean, scale = features.mean(0, dtype=np.float64), features.std(0, dtype=np.float64) + 1e-3
    classifier, kept = Classifier(mean, scale, np.zeros(features.shape[1] + 1)), np.ones(len(features), bool)
    for _ in range(ROUNDS):
        normal = (features[kept] - mean) / scale
        offset = features[kept, 0].astype(np.float64)
        classifier = Classifier(mean, scale, fit_logistic(normal, is_tool[kept], weight[kept], offset, RIDGE))
        kept = is_tool | (probability(classifier.log_odds(features)) < MAX_TISSUE_PROBABILITY)
    return classifier


def fit_logistic(
    features: NDArray, is_tool: Mask, weight: NDArray, offset: NDArray, ridge: float
) -> NDArray[np.float64]:
    """Logistic regression by damped Newton steps: (k + 1,) coefficients of the features, and a constant, which add to
    the `offset` (n,), log-odds that are known before. `ridge`, above 0, holds the coefficients of features (n, k) near
    0.
    """
    x = np.hstack([features, np.ones((len(features), 1))]).astype(np.float64)
    penalty, sign = np.append(np.full(features.shape[1], ridge), 1e-3), np.where(is_tool, 1.0, -1.0)
    found = np.zeros(x.shape[1])

    def loss(at: NDArray) -> float:
        return float(weight @ np.logaddexp(0, -sign * (offset + x @ at)) + penalty @ at**2 / 2)

    now = loss(found)
    for _ in range(MAX_STEPS):
        p = probability(offset + x @ found)
        gradient = x.T @ (weight * (p - is_tool)) + penalty * found
        curvature = (x * (weight * p * (1 - p))[:, None]).T @ x + np.diag(penalty)
        step, share = np.linalg.solve(curvature, gradient), 1.0
        while (then := loss(found - share * step)) > now:
            share /= 2
            if share < MIN_STEP:
                return found
        found, gain, now = found - share * step, now - then, then
        if gain < SMALL_GAIN:
            break
    return found


def probability(log_odds: NDArray) -> NDArray:
    """Of log-odds; without overflow."""
    return 1 / (1 + np.exp(-np.clip(log_odds, -50, 50)))
