"""Tool masks where none are given: what this clip's tools look like is learned from a few frames, then looked up.

Blood makes tissue red, tools are not. Gray regions that enter from the border are taken for tools first (seeds); the
colors found in and beside them, and nowhere else, then become tool colors, so that a gold collar or a dark shaft is
learned too. The share of tool pixels among all pixels of a color is the whole model; depth, where there is any,
adds how much nearer than its surroundings a tool is. A start for correction by hand, not a segmentation network.

Brightness is relative to the clip's highlights, so that exposure does not matter. All work is done on a copy whose
longer side has `WORK_PX` pixels, so that radii mean the same for every size of picture. `H, W` image size, `h, w` size
of that copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from ..core.checks import check_shape

WORK_PX = 384
"""Longer side of the copy that is looked at, px: a shaft is some 30 px wide there, a jaw 6."""
DARK = 0.04
"""Added to every channel before logarithms: about the noise of dark pixels, whose color would otherwise be chance."""
SEED_REDNESS = 0.45
"""A seed is less red than this share of the clip's median: half way to neutral, and a little stricter."""
LEAST_REDNESS = 0.1
"""Median log(red / green) below which a clip is too gray for its colors to tell tools from tissue."""
SEED_BRIGHTNESS = 0.1
"""Darker pixels start no tool: shadows and dark corners have no reliable color."""
NEAR_PX = 16
"""How far beside a seed other parts of the same tool are looked for: half the width of a shaft."""
NEAR_WEIGHT = 0.3
"""A pixel beside a seed counts this much as a tool: less than half, because most of them are tissue."""
SURE, POSSIBLE = 0.5, 0.35
"""Probabilities from which a pixel is a tool by itself, and from which it is one beside such pixels."""
REACH = 0.75
"""A tool enters end first: it reaches further into the view than this share of its contact with the border is long.
At 0.5 an organ along the border passes; at 1 a thick shaft that has just come in no longer does."""
LEAST_SHARE = 0.002
"""Smaller regions, as a share of the view, are dropped: at 640x512 about 25 px square."""
SHINE = (0.6, 0.8)
"""Least channel from which a pixel starts to show the lamp rather than itself, and shows nothing else."""
RIM_PX = 2
"""The outline is widened by this much to cover the blended pixels at the tool's edge; in small pictures by as many of
their own pixels."""
RELIEF_ODDS = 4.0
"""Depth changes the odds at most by this factor: stereo is often wrong on shiny metal."""

_BINS = (32, 24, 6)
"""Cells of the color table along log(red / green), log(blue / green) and the root of brightness."""
_LOW, _HIGH = np.array([-0.3, -0.9, 0.0]), np.array([1.2, 0.6, 1.0])
_RELIEF_EDGES = np.linspace(-0.6, 0.6, 41)
"""Cells of log(surroundings / depth); beyond a factor of 1.8 more or less is all the same."""


@dataclass(frozen=True)
class ToolModel:
    """What the tools of one clip look like."""

    color_probability: NDArray[np.float32]
    """(cells,) share of tool pixels among the pixels of each color, 0..1."""
    relief_odds: NDArray[np.float32] | None
    """(cells + 1,) how much likelier a relief is on a tool than beside one; last: not measured. None without depth."""
    white: float
    """Level of the clip's highlights, 0..255; brightness is relative to it."""
    seen_share: float
    """Share of the sample frames in which a tool was found, 0..1. At 0 every mask will be (nearly) empty: say so."""

    def mask(
        self, rgb_u8: NDArray[np.uint8], view: NDArray[np.bool_], depth: NDArray[np.float32] | None = None
    ) -> NDArray[np.bool_]:
        """Mark the tools of one frame; about 25 ms at 640x512.

        Args:
            rgb_u8: (H, W, 3) color, 0..255.
            view: (H, W) True inside the endoscope's image.
            depth: (H, W) z, mm, 0 or not finite where missing; used only if the model was fitted with depth.
        Returns:
            (H, W) True on tools: closed regions that enter from the border of the view, a rim of 2 to 3 px included.
        Raises:
            ValueError: shapes that do not match.
        """
        sample = _shrink(rgb_u8, view, depth, self.white)
        found = _find(self, sample)
        scale = WORK_PX / max(view.shape)
        wide = cv2.dilate(found.astype(np.uint8), _disk(round(RIM_PX * max(1.0, scale))))
        large = cv2.resize(wide.astype(np.float32), view.shape[::-1], interpolation=cv2.INTER_LINEAR)
        return (large > 0.5) & view


def fit_tools(
    pictures: Sequence[NDArray[np.uint8]],
    views: Sequence[NDArray[np.bool_]],
    depths: Sequence[NDArray[np.float32]] | None = None,
) -> ToolModel:
    """Learn what the tools of a clip look like from 10 to 20 frames spread over it; about 1 s at 640x512.

    Args:
        pictures: (H, W, 3) each, color, 0..255.
        views: (H, W) each, True inside the endoscope's image.
        depths: (H, W) each, z, mm, 0 or not finite where missing; None where there is no depth.
    Raises:
        ValueError: no pictures, lists of unequal length, or shapes that do not match.
    """
    if not pictures:
        raise ValueError("pictures must hold at least one frame; got none")
    known = depths if depths is not None else [None] * len(pictures)
    white = _white(pictures, views)
    samples = [_shrink(*parts, white) for parts in zip(pictures, views, known, strict=True)]
    redness = np.concatenate([sample.redness[sample.view] for sample in samples])
    typical = float(np.median(redness)) if redness.size else 0.0
    if typical < LEAST_REDNESS:
        return ToolModel(np.zeros(np.prod(_BINS), np.float32), None, white, 0.0)
    limit = SEED_REDNESS * typical
    # What is known of a color before looking: gray is likelier a tool than red.
    cell_redness = _LOW[0] + (np.arange(_BINS[0]) + 0.5) / _BINS[0] * (_HIGH[0] - _LOW[0])
    prior = 1 / (1 + np.exp((cell_redness - limit) / (0.15 * typical)))
    seeds = [_seeds(sample, limit) for sample in samples]
    model = _learn(samples, seeds, prior, white)
    # The second round starts from whole tools instead of their gray parts; a third changes nothing.
    model = _learn(samples, [_find(model, sample) for sample in samples], prior, white)
    return replace(model, seen_share=float(np.mean([_find(model, sample).any() for sample in samples])))


@dataclass(frozen=True)
class _Sample:
    """One frame at working size."""

    view: NDArray[np.bool_]
    """(h, w) True inside the endoscope's image."""
    redness: NDArray[np.float32]
    """(h, w) log(red / green)."""
    brightness: NDArray[np.float32]
    """(h, w) largest channel; 1 is the clip's white."""
    cell: NDArray[np.int32]
    """(h, w) cell of the color table."""
    shine: NDArray[np.float32]
    """(h, w) 0..1, how much of the pixel's color is that of the lamp."""
    depth: NDArray[np.float32] | None
    """(h, w) mm, 0 where missing."""


def _white(pictures: Sequence[NDArray[np.uint8]], views: Sequence[NDArray[np.bool_]]) -> float:
    """The level, 0..255, that half a percent of the pixels of all views exceed: that of highlights."""
    levels = []
    for picture, view in zip(pictures, views, strict=True):
        check_shape("picture:H,W,3 view:H,W", picture=picture, view=view)
        levels.append(picture[::4, ::4].max(-1)[view[::4, ::4]])
    level = np.concatenate(levels)
    return max(float(np.percentile(level, 99.5)), 1.0) if level.size else 255.0


def _shrink(
    rgb_u8: NDArray[np.uint8], view: NDArray[np.bool_], depth: NDArray[np.float32] | None, white: float
) -> _Sample:
    """The frame at working size, with everything that is looked at per pixel."""
    check_shape("rgb_u8:H,W,3 view:H,W", rgb_u8=rgb_u8, view=view)
    scale = WORK_PX / max(view.shape)
    size = (max(1, round(view.shape[1] * scale)), max(1, round(view.shape[0] * scale)))
    small = cv2.resize(rgb_u8, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    inside = cv2.resize(view.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    color = cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float32) / np.float32(white)
    log_color = np.log(color + DARK)
    redness, blueness = log_color[..., 0] - log_color[..., 1], log_color[..., 2] - log_color[..., 1]
    brightness = color.max(-1)
    cell = np.zeros(redness.shape, np.int32)
    for axis, value in enumerate((redness, blueness, np.sqrt(brightness))):
        position = (value - _LOW[axis]) / (_HIGH[axis] - _LOW[axis]) * _BINS[axis]
        cell = cell * _BINS[axis] + np.clip(position, 0, _BINS[axis] - 1).astype(np.int32)
    paleness = (small.min(-1).astype(np.float32) / np.float32(white) - SHINE[0]) / (SHINE[1] - SHINE[0])
    shine = cv2.dilate(np.clip(paleness, 0, 1), _disk(2))
    if depth is not None:
        check_shape("view:H,W depth:H,W", view=view, depth=depth)
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
        depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    return _Sample(inside, redness, brightness, cell, shine, depth)


def _seeds(sample: _Sample, limit: float) -> NDArray[np.bool_]:
    """(h, w) gray regions that enter from the border."""
    gray = (sample.redness < limit) & (sample.brightness > SEED_BRIGHTNESS) & sample.view
    return _entering(cv2.morphologyEx(gray.astype(np.uint8), cv2.MORPH_OPEN, _disk(2)), sample.view)


def _learn(
    samples: list[_Sample], tools: list[NDArray[np.bool_]], prior: NDArray[np.float64], white: float
) -> ToolModel:
    """Count colors and reliefs on the regions `tools` (h, w), beside them and far from them."""
    on_tool, elsewhere = np.zeros((2, int(np.prod(_BINS))))
    relief_on, relief_off = np.zeros((2, len(_RELIEF_EDGES) + 2))
    for sample, tool in zip(samples, tools, strict=True):
        whole = _fill(cv2.morphologyEx(tool.astype(np.uint8), cv2.MORPH_CLOSE, _disk(5))) & sample.view
        near = (cv2.dilate(whole.astype(np.uint8), _disk(NEAR_PX)) > 0) & sample.view & ~whole
        matte = 1 - sample.shine  # highlights look alike on everything: they teach nothing
        for count, weight in ((on_tool, whole + NEAR_WEIGHT * near), (elsewhere, sample.view & ~near & ~whole)):
            count += np.bincount(sample.cell.ravel(), (matte * weight).ravel(), count.size)
        if sample.depth is not None:
            relief = _relief(sample.depth, sample.view & ~whole)
            relief_on += np.bincount(relief[whole], minlength=relief_on.size)
            relief_off += np.bincount(relief[sample.view & ~whole], minlength=relief_on.size)
    # Neighboring cells share what they saw; a cell that saw less than 1/50,000 of all pixels leans on the prior.
    on_tool, elsewhere = (gaussian_filter(count.reshape(_BINS), (0.7, 0.7, 0.5)) for count in (on_tool, elsewhere))
    lean = max(2e-5 * (on_tool.sum() + elsewhere.sum()), 1e-9)
    probability = (on_tool + lean * prior[:, None, None]) / (on_tool + elsewhere + lean)
    odds = None
    if relief_on.any() and relief_off.any():
        on, off = (gaussian_filter1d(count[:-1], 1.5) / count.sum() + 0.002 for count in (relief_on, relief_off))
        odds = np.append(np.clip(on / off, 1 / RELIEF_ODDS, RELIEF_ODDS), 1.0).astype(np.float32)
    return ToolModel(probability.ravel().astype(np.float32), odds, white, seen_share=0.0)


def _find(model: ToolModel, sample: _Sample) -> NDArray[np.bool_]:
    """(h, w) True on the tools of one frame, without a rim."""
    return _clean(_probability(model, sample), sample.view)


def _probability(model: ToolModel, sample: _Sample) -> NDArray[np.float32]:
    """(h, w) that a pixel shows a tool, 0..1. Highlights take the mean of what surrounds them."""
    probability = model.color_probability[sample.cell]
    if model.relief_odds is not None and sample.depth is not None:
        relief = _relief(sample.depth, sample.view & (probability < SURE))
        odds = probability / (1 - probability + 1e-6) * model.relief_odds[relief]
        probability = odds / (1 + odds)
    matte = (1 - sample.shine) * sample.view + np.float32(1e-3)
    around = cv2.GaussianBlur(matte * probability, (0, 0), 4) / cv2.GaussianBlur(matte, (0, 0), 4)
    return (probability + sample.shine * (around - probability)) * sample.view


def _relief(depth: NDArray[np.float32], tissue: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(h, w) cell of log(surroundings / depth), positive nearer than the `tissue` around; the last cell: missing."""
    # Surroundings are smooth: a quarter of the size is enough.
    size = (max(1, depth.shape[1] // 4), max(1, depth.shape[0] // 4))
    known = ((depth > 0) & tissue).astype(np.float32)
    total, count = (cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (known * depth, known))
    spread = WORK_PX / 4 / 8  # an eighth of the picture: wider than a tool, narrower than the scene's own slope
    total, count = (cv2.GaussianBlur(x, (0, 0), spread) for x in (total, count))
    level = cv2.resize(total / np.maximum(count, 1e-6), depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    measured = (depth > 0) & (level > 0)
    relief = np.log(np.where(measured, level, 1) / np.where(measured, depth, 1))
    return np.where(measured, np.digitize(relief, _RELIEF_EDGES), len(_RELIEF_EDGES) + 1)


def _clean(probability: NDArray[np.float32], view: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) closed regions that enter from the border: sure pixels and the possible ones beside them."""
    smooth = cv2.GaussianBlur(probability, (0, 0), 1.0)
    sure = cv2.morphologyEx((smooth > SURE).astype(np.uint8), cv2.MORPH_OPEN, _disk(1))
    possible = (smooth > POSSIBLE) & (cv2.dilate(sure, _disk(NEAR_PX // 2)) > 0)
    closed = cv2.morphologyEx(sure | possible.astype(np.uint8), cv2.MORPH_CLOSE, _disk(5))
    return _fill(_entering(cv2.morphologyEx(closed, cv2.MORPH_OPEN, _disk(1)), view)) & view


def _entering(mask: NDArray[np.uint8], view: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) the regions of `mask` that come in from the border of the view end first, as tools do."""
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
        # A tool that crosses the view touches it twice: the longer of the contacts counts.
        pieces = cv2.connectedComponentsWithStats(contact.astype(np.uint8), connectivity=8)[2][1:]
        length = np.hypot(pieces[:, cv2.CC_STAT_WIDTH], pieces[:, cv2.CC_STAT_HEIGHT]).max()
        reach = cv2.distanceTransform((~contact).astype(np.uint8), cv2.DIST_L2, 5)[region].max()
        keep[i] = reach > REACH * length
    return keep[label]


def _fill(mask: NDArray) -> NDArray[np.bool_]:
    """(h, w) the regions of `mask` without holes."""
    filled = np.zeros(mask.shape, np.uint8)
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(filled, outlines, -1, 1, -1)
    return filled > 0


def _disk(radius: int) -> NDArray[np.uint8]:
    """Structuring element of that radius, px."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
