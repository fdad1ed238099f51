"""Leave out what tools color around their masks: as many pixels as measured on the clip, none where masks are exact.

What is learned beside a tool that rests fills the gap behind it, so a rim of its color becomes a stripe there. Blur,
compression of color, narrow shadows and masks that are drawn too tight put a tool's color on pixels that a mask calls
tissue. Along the normals of mask edges, `share` tells how far the color has gone from that of the tissue (well outside)
to that of the tool (well inside). `H, W` image size, `P` points of mask edges, `K` rings.

Ring k holds the pixels k px outside of the mask: ring 1 touches it, ring 0 is the outermost one inside. Distances below
are px at an image width of 640; they are scaled to the width of the clip.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.ranges import spread
from ..data import FrameSequence
from ..footage.components import Image, Mask, disk, distance_inside, grown, large_regions
from . import regions
from .sequence import view_of

SAMPLES = 16  # Training frames that are measured
WIDTH_PX = 640
TOOL, TISSUE = (-7, -3), (12, 16)  # First and last ring that give a point its color of the tool and of the tissue
CALM = (6, 12)
"""First and last ring that must have the tissue's color already: else the point lies in a broad shadow, or the tissue
changes by itself."""
CALM_SHARE = 0.25  # Largest share there
LEAST_CONTRAST = 20  # Distance between both colors, of 0..255 each: with less, the share of a point is noise
LEAST_POINTS = 200  # With fewer points nothing is known
MOST_POINTS = 10_000  # Points of one frame that are looked at; of more, as around scattered holes, every n-th
LEAST_SHARE = 0.12
"""A ring with a larger share is colored by tools. Phantoms, whose masks are exact, have at most 0.05 in ring 1."""
MOST = 4  # Largest margin
LEAST_SCALE = 0.25  # Images below 160 px in width are measured with the distances of these, or rings would coincide


@dataclass(frozen=True)
class ColorReach:
    """Share of the tool's color by distance from the mask."""

    shares: NDArray[np.float64]
    """(K,) median over points, of rings 1 to K; 0 is tissue, 1 is tool. Zeros if there are too few points."""
    num_points: int  # Points of mask edges that were measured

    @property
    def margin_px(self) -> int:
        """Rings around the mask that tools color, px: those up to the first with a small share, at most K."""
        colored = self.shares > LEAST_SHARE
        return len(colored) if colored.all() else int(colored.argmin())


def with_tool_margin(sequence: FrameSequence) -> tuple[FrameSequence, int]:
    """The sequence without the pixels that tools color, and the width of the margin around their masks, px."""
    indices = sequence.indices("train")
    frames = [sequence.frame(indices[k]) for k in spread(len(indices), SAMPLES)]
    view = view_of(frames)
    margin_px = color_reach(((frame.rgb_u8, frame.tissue_mask) for frame in frames), view).margin_px
    if not margin_px:
        return sequence, 0
    return sequence.with_tissue(lambda frame: away_from_tools(frame.tissue_mask, view, margin_px)), margin_px


def away_from_tools(tissue: Mask, view: Mask, margin_px: int) -> Mask:
    """(H, W) `tissue` without the pixels up to `margin_px` from a tool: from masked regions of at least
    `regions.LEAST_SHARE` of the view. Others are failed stereo, highlights and the like; beyond the view nothing has a
    color.
    """
    tools = large_regions(~tissue & view, regions.LEAST_SHARE * view.sum())
    return tissue & ~grown(tools, disk(margin_px))


def color_reach(frames: Iterable[tuple[Image, Mask]], view: Mask) -> ColorReach:
    """Measure how far tools color the pixels around their masks, from (H, W, 3) color and (H, W) tissue of a few frames
    of one clip. Edges of masks count inside the view (H, W).
    """
    scale = max(view.shape[1] / WIDTH_PX, LEAST_SCALE)
    rings = np.arange(_px(TOOL[0], scale), _px(TISSUE[1], scale) + 1)
    measured = [_edge_shares(rgb_u8, tissue, view, rings, scale) for rgb_u8, tissue in frames]
    shares = np.concatenate([np.empty((0, len(rings)), np.float32), *measured])
    most = max(_px(MOST, scale), 1)
    if len(shares) < LEAST_POINTS:
        return ColorReach(np.zeros(most), len(shares))
    return ColorReach(np.median(shares[:, (rings >= 1) & (rings <= most)], axis=0).astype(float), len(shares))


def _edge_shares(rgb_u8: Image, tissue: Mask, view: Mask, rings: NDArray, scale: float) -> NDArray:
    """(P, len(rings)) share of the tool's color, at the points of one frame's mask edges that can be measured."""

    def between(ends: tuple[int, int]) -> Mask:
        return (rings >= _px(ends[0], scale)) & (rings <= _px(ends[1], scale))

    x, y = _normals(tissue, view, rings, scale)
    color = cv2.remap(rgb_u8, x, y, cv2.INTER_LINEAR).astype(np.float32) if len(x) else np.empty((*x.shape, 3))
    ours = color[:, between(TISSUE)].mean(1, keepdims=True)
    way = color[:, between(TOOL)].mean(1, keepdims=True) - ours
    length = (way**2).sum(-1)
    shares = ((color - ours) * way).sum(-1) / np.maximum(length, 1e-6)
    calm = (np.abs(shares[:, between(CALM)]) < CALM_SHARE).all(1)
    return shares[calm & (length[:, 0] > LEAST_CONTRAST**2)].astype(np.float32)


def _normals(tissue: Mask, view: Mask, rings: NDArray, scale: float) -> tuple[NDArray, NDArray]:
    """Columns and rows (P, len(rings)) of points along the normals of the mask's edges.

    Left out are normals that leave the view, and those on which distances are not those from the edge where they start,
    as between two tools, across a thin jaw, at a corner, or around a hole of the mask.
    """
    outside = distance_inside(tissue)
    distance = np.where(tissue, outside, 1 - distance_inside(~tissue))  # 1 in ring 1, 0 in ring 0
    smooth = cv2.GaussianBlur(distance, (0, 0), max(2 * scale, 1.0))
    slope = np.stack([cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) / 8 for order in ((1, 0), (0, 1))])
    row, column = np.nonzero(tissue & view & (outside <= 1))
    row, column = (each[:: 1 + len(row) // MOST_POINTS] for each in (row, column))
    normal = slope[:, row, column]
    steep = np.linalg.norm(normal, axis=0)
    row, column, normal = (each[..., steep > 0.5] for each in (row, column, normal / np.maximum(steep, 1e-6)))
    x, y = (
        (at[:, None] + along[:, None] * (rings - 1)).astype(np.float32)
        for at, along in zip((column, row), normal, strict=True)
    )
    if not len(x):
        return x, y
    is_in_view = cv2.remap(view.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) > 0.99
    off = np.abs(cv2.remap(distance, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) - rings)
    usable = (is_in_view & (off < max(scale, 1.0))).all(1)
    return x[usable], y[usable]


def _px(distance: float, scale: float) -> int:
    """A distance at a width of 640 px, rounded; inside the mask, where it is negative, at least one ring deep."""
    return min(round(distance * scale), -1) if distance < 0 else round(distance * scale)
