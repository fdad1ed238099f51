"""Detect tools by color and depth, with a model fitted to a few frames of the clip.

Blood makes tissue red; tools are not red. Seeds are gray regions that enter from the image border. Colors that occur in
and next to the seeds, and nowhere else, become tool colors; this adds gold collars and dark shafts. The model is a
table: the share of tool pixels for each color. If there is depth, it also learns how much nearer tools are than their
surroundings. The masks are a starting point for manual correction, not the result of a segmentation network.

Brightness is relative to the highlights of the clip, so that exposure does not matter. All images are resized to
`WORK_PX` pixels on the longer side, so that radii have the same meaning for every image size. `H, W` image size, `h, w`
resized image size.
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
"""Longer side of the resized image, px: a shaft is about 30 px wide, a jaw 6."""
DARK = 0.04
"""Added to every channel before the logarithm: about the noise of dark pixels, which have no reliable color."""
SEED_REDNESS = 0.45
"""A seed is less red than this share of the clip's median redness."""
LEAST_REDNESS = 0.1
"""Median log(red / green) below which a clip is too gray to separate tools from tissue by color."""
SEED_BRIGHTNESS = 0.1
"""Darker pixels are never seeds: shadows and dark corners have no reliable color."""
NEAR_PX = 16
"""Other parts of the same tool are searched within this distance of a seed: half the width of a shaft."""
NEAR_WEIGHT = 0.3
"""Weight of a pixel near a seed in the tool counts: below 0.5, because most of these pixels are tissue."""
SURE, POSSIBLE = 0.5, 0.35
"""Thresholds of the tool probability: a pixel on its own, and a pixel next to such pixels (hysteresis)."""
REACH = 0.75
"""A tool enters end first: it must reach into the view by this share of the length of its contact with the border.
At 0.5 an organ along the border passes; at 1 a thick shaft that has just entered fails."""
LEAST_SHARE = 0.002
"""Smaller regions, as a share of the view, are removed: about 25 px square at 640x512."""
SHINE = (0.6, 0.8)
"""Range of the smallest channel over which a pixel changes from surface color to pure highlight."""
RIM_PX = 2
"""The mask is dilated by this much to cover mixed pixels at the tool's edge."""
RELIEF_ODDS = 4.0
"""Depth changes the odds at most by this factor, because stereo depth is often wrong on shiny metal."""

_BINS = (32, 24, 6)
"""Cells of the color table along log(red / green), log(blue / green) and the root of brightness."""
_LOW, _HIGH = np.array([-0.3, -0.9, 0.0]), np.array([1.2, 0.6, 1.0])
_RELIEF_EDGES = np.linspace(-0.6, 0.6, 41)
"""Bin edges of log(surroundings / depth); values beyond a factor of 1.8 share the outer bins."""


@dataclass(frozen=True)
class ToolModel:
    """Color and depth statistics of the tools of one clip."""

    color_probability: NDArray[np.float32]
    """(cells,) share of tool pixels among the pixels of each color, 0..1."""
    relief_odds: NDArray[np.float32] | None
    """(cells + 1,) likelihood ratio of a relief on a tool to one next to it; last: no depth. None without depth."""
    white: float
    """Brightness of the clip's highlights, 0..255."""
    detected_share: float
    """Share of the sample frames in which a tool was detected, 0..1. If it is 0, all masks will be (nearly) empty."""

    def mask(
        self, rgb_u8: NDArray[np.uint8], view: NDArray[np.bool_], depth: NDArray[np.float32] | None = None
    ) -> NDArray[np.bool_]:
        """Tool mask of one frame; about 25 ms at 640x512.

        Args:
            rgb_u8: (H, W, 3) color, 0..255.
            view: (H, W) True inside the endoscope's image.
            depth: (H, W) z, mm, 0 or not finite where missing; used only if the model was fitted with depth.
        Returns:
            (H, W) True on tools: filled regions that enter from the border of the view, dilated by 2 to 3 px.
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
    images: Sequence[NDArray[np.uint8]],
    views: Sequence[NDArray[np.bool_]],
    depths: Sequence[NDArray[np.float32]] | None = None,
) -> ToolModel:
    """Fit the tool model to 10 to 20 frames spread over the clip; about 1 s at 640x512.

    Args:
        images: (H, W, 3) each, color, 0..255.
        views: (H, W) each, True inside the endoscope's image.
        depths: (H, W) each, z, mm, 0 or not finite where missing; None where there is no depth.
    Raises:
        ValueError: no images, lists of unequal length, or shapes that do not match.
    """
    if not images:
        raise ValueError("images must hold at least one frame, got none")
    known = depths if depths is not None else [None] * len(images)
    white = _white(images, views)
    samples = [_shrink(*parts, white) for parts in zip(images, views, known, strict=True)]
    redness = np.concatenate([sample.redness[sample.view] for sample in samples])
    typical = float(np.median(redness)) if redness.size else 0.0
    if typical < LEAST_REDNESS:
        return ToolModel(np.zeros(np.prod(_BINS), np.float32), None, white, 0.0)
    limit = SEED_REDNESS * typical
    # Prior of a color: gray is more likely a tool than red.
    cell_redness = _LOW[0] + (np.arange(_BINS[0]) + 0.5) / _BINS[0] * (_HIGH[0] - _LOW[0])
    prior = 1 / (1 + np.exp((cell_redness - limit) / (0.15 * typical)))
    seeds = [_seeds(sample, limit) for sample in samples]
    model = _learn(samples, seeds, prior, white)
    # The second round starts from whole tools instead of their gray parts. A third round changes nothing.
    model = _learn(samples, [_find(model, sample) for sample in samples], prior, white)
    return replace(model, detected_share=float(np.mean([_find(model, sample).any() for sample in samples])))


@dataclass(frozen=True)
class _Sample:
    """One resized frame."""

    view: NDArray[np.bool_]
    """(h, w) True inside the endoscope's image."""
    redness: NDArray[np.float32]
    """(h, w) log(red / green)."""
    brightness: NDArray[np.float32]
    """(h, w) largest channel; 1 is the clip's white."""
    cell: NDArray[np.int32]
    """(h, w) cell of the color table."""
    shine: NDArray[np.float32]
    """(h, w) 0..1, share of specular reflection in the pixel's color."""
    depth: NDArray[np.float32] | None
    """(h, w) mm, 0 where missing."""


def _white(images: Sequence[NDArray[np.uint8]], views: Sequence[NDArray[np.bool_]]) -> float:
    """Brightness of highlights: the level, 0..255, that 0.5 % of all pixels exceed."""
    levels = []
    for image, view in zip(images, views, strict=True):
        check_shape("image:H,W,3 view:H,W", image=image, view=view)
        levels.append(image[::4, ::4].max(-1)[view[::4, ::4]])
    level = np.concatenate(levels)
    return max(float(np.percentile(level, 99.5)), 1.0) if level.size else 255.0


def _shrink(
    rgb_u8: NDArray[np.uint8], view: NDArray[np.bool_], depth: NDArray[np.float32] | None, white: float
) -> _Sample:
    """The resized frame with its features per pixel."""
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
    return entering_regions(cv2.morphologyEx(gray.astype(np.uint8), cv2.MORPH_OPEN, _disk(2)), sample.view)


def _learn(
    samples: list[_Sample], tools: list[NDArray[np.bool_]], prior: NDArray[np.float64], white: float
) -> ToolModel:
    """Count colors and reliefs on the regions `tools` (h, w), next to them and far from them."""
    on_tool, elsewhere = np.zeros((2, int(np.prod(_BINS))))
    relief_on, relief_off = np.zeros((2, len(_RELIEF_EDGES) + 2))
    for sample, tool in zip(samples, tools, strict=True):
        whole = _fill(cv2.morphologyEx(tool.astype(np.uint8), cv2.MORPH_CLOSE, _disk(5))) & sample.view
        near = (cv2.dilate(whole.astype(np.uint8), _disk(NEAR_PX)) > 0) & sample.view & ~whole
        matte = 1 - sample.shine  # highlights have the same color on tools and tissue
        for count, weight in ((on_tool, whole + NEAR_WEIGHT * near), (elsewhere, sample.view & ~near & ~whole)):
            count += np.bincount(sample.cell.ravel(), (matte * weight).ravel(), count.size)
        if sample.depth is not None:
            relief = relief_cells(sample.depth, sample.view & ~whole)
            relief_on += np.bincount(relief[whole], minlength=relief_on.size)
            relief_off += np.bincount(relief[sample.view & ~whole], minlength=relief_on.size)
    # Smooth over neighboring cells. A cell with less than 1/50,000 of all pixels relies on the prior.
    on_tool, elsewhere = (gaussian_filter(count.reshape(_BINS), (0.7, 0.7, 0.5)) for count in (on_tool, elsewhere))
    prior_weight = max(2e-5 * (on_tool.sum() + elsewhere.sum()), 1e-9)
    probability = (on_tool + prior_weight * prior[:, None, None]) / (on_tool + elsewhere + prior_weight)
    odds = None
    if relief_on.any() and relief_off.any():
        on, off = (gaussian_filter1d(count[:-1], 1.5) / count.sum() + 0.002 for count in (relief_on, relief_off))
        odds = np.append(np.clip(on / off, 1 / RELIEF_ODDS, RELIEF_ODDS), 1.0).astype(np.float32)
    return ToolModel(probability.ravel().astype(np.float32), odds, white, detected_share=0.0)


def _find(model: ToolModel, sample: _Sample) -> NDArray[np.bool_]:
    """(h, w) True on the tools of one frame, before dilation."""
    return _clean(_probability(model, sample), sample.view)


def _probability(model: ToolModel, sample: _Sample) -> NDArray[np.float32]:
    """(h, w) tool probability, 0..1. Highlights get the mean of their surroundings."""
    probability = model.color_probability[sample.cell]
    if model.relief_odds is not None and sample.depth is not None:
        relief = relief_cells(sample.depth, sample.view & (probability < SURE))
        odds = probability / (1 - probability + 1e-6) * model.relief_odds[relief]
        probability = odds / (1 + odds)
    matte = (1 - sample.shine) * sample.view + np.float32(1e-3)
    around = cv2.GaussianBlur(matte * probability, (0, 0), 4) / cv2.GaussianBlur(matte, (0, 0), 4)
    return (probability + sample.shine * (around - probability)) * sample.view


def relief_cells(depth: NDArray[np.float32], tissue: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(h, w) cell of log(surroundings / depth), positive nearer than the `tissue` around; the last cell: missing."""
    # Surroundings are smooth: a quarter of the size is enough.
    size = (max(1, depth.shape[1] // 4), max(1, depth.shape[0] // 4))
    known = ((depth > 0) & tissue).astype(np.float32)
    total, count = (cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (known * depth, known))
    spread = WORK_PX / 4 / 8  # an eighth of the image: wider than a tool, narrower than the scene's own slope
    total, count = (cv2.GaussianBlur(x, (0, 0), spread) for x in (total, count))
    level = cv2.resize(total / np.maximum(count, 1e-6), depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    measured = (depth > 0) & (level > 0)
    relief = np.log(np.where(measured, level, 1) / np.where(measured, depth, 1))
    return np.where(measured, np.digitize(relief, _RELIEF_EDGES), len(_RELIEF_EDGES) + 1)


def _clean(probability: NDArray[np.float32], view: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) filled regions that enter from the border: sure pixels and the possible ones next to them."""
    smooth = cv2.GaussianBlur(probability, (0, 0), 1.0)
    sure = cv2.morphologyEx((smooth > SURE).astype(np.uint8), cv2.MORPH_OPEN, _disk(1))
    possible = (smooth > POSSIBLE) & (cv2.dilate(sure, _disk(NEAR_PX // 2)) > 0)
    closed = cv2.morphologyEx(sure | possible.astype(np.uint8), cv2.MORPH_CLOSE, _disk(5))
    return _fill(entering_regions(cv2.morphologyEx(closed, cv2.MORPH_OPEN, _disk(1)), view)) & view


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


def _fill(mask: NDArray) -> NDArray[np.bool_]:
    """(h, w) the regions of `mask` with holes filled."""
    filled = np.zeros(mask.shape, np.uint8)
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(filled, outlines, -1, 1, -1)
    return filled > 0


def _disk(radius: int) -> NDArray[np.uint8]:
    """Structuring element of that radius, px."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
