"""Tool pixels that a mask misses, found while training: a tool is what the scene cannot explain.

Masks that a program found miss jaws, blurred ends, and tools that are there for a moment; trained as tissue, they
become a ghost. A few frames of a tool do not change the shared scene much at first, so the error of the rendered image
shows the tool. Where the error is far above that of the frame, in a region that continues a masked tool or enters from
the border as tools do, and the tool network is not sure of tissue, pixels do not count. That is decided anew each time
a frame is rendered. How much of each frame was left out in its last visits says which masks are likely wrong.

`H, W` image size, `h, w` size of the resized image, 160 px on its longer side, `F` training frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..data import FrameSequence
from ..system.memory import BoundedCache, cache_bytes
from ..tool_masks import ToolFinder
from ..tool_masks.regions import disk, entering_regions, filled
from ..tool_masks.tool_finder import view_of
from .frames import TrainingFrame

WORK_PX = 160  # longer side of the resized image, px: a shaft is about 12 px wide, a jaw 3
START = 0.1  # share of the fine stage after which the scene explains resting tissue
SMOOTH_PX = 3.0  # standard deviation of the window over which the error is averaged, px
SURE, POSSIBLE = (3.0, 0.02), (1.5, 0.01)
"""Errors of a missed tool, as a multiple of the frame's median error plus a constant (colors are 0..1): a pixel on its
own, and a pixel near such pixels (hysteresis)."""
NEAR_PX = 8  # a possible pixel counts within this distance of a sure one
GAP_PX = 6  # gaps up to twice this width are closed: the middle of a shaft is often explained by its own color
HIGHLIGHT = (0.5, 0.7)
"""Smallest color channel from which, and up to which, an error counts less: highlights move on tissue too."""
SURELY_TISSUE = -3.0  # log-odds of a tool below which a pixel always counts
SAMPLES = 12  # frames from which the border of the view is taken
VISITS = 4  # number of visits that are kept of each frame: early ones show what the scene had not learned yet
MIN_MISSED_TOOL_SHARE = 0.005  # share of the view from which on a visit speaks for one: about 40 px square at 640x512
MIN_VISITS = 2  # so many of the last visits must; a single one may be a highlight


def missed_tools(
    rendered: NDArray[np.float32],
    rgb: NDArray[np.float32],
    tissue_mask: NDArray[np.bool_],
    view: NDArray[np.bool_],
    surely_tissue: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """(h, w) True on pixels of `tissue_mask` that show a tool rather than tissue.

    Args:
        rendered, rgb: (h, w, 3) color in [0, 1].
        view: (h, w) True inside the endoscope's image. surely_tissue: (h, w) True where the tool network is sure.
    """
    if not tissue_mask.any():
        return np.zeros_like(tissue_mask)
    shine = cv2.dilate(np.clip((rgb.min(-1) - HIGHLIGHT[0]) / (HIGHLIGHT[1] - HIGHLIGHT[0]), 0, 1), disk(2))
    weight = (tissue_mask * (1 - shine) + 1e-3).astype(np.float32)
    error = np.abs(rendered - rgb).mean(-1) * weight
    error = cv2.GaussianBlur(error, (0, 0), SMOOTH_PX) / cv2.GaussianBlur(weight, (0, 0), SMOOTH_PX)
    usual = float(np.median(error[tissue_mask]))
    open_to_doubt = tissue_mask & ~surely_tissue
    sure, possible = ((error > factor * usual + least) & open_to_doubt for factor, least in (SURE, POSSIBLE))
    seed = cv2.morphologyEx(sure.astype(np.uint8), cv2.MORPH_OPEN, disk(2))
    if not seed.any():
        return np.zeros_like(tissue_mask)
    body = (seed > 0) | (possible & (cv2.dilate(seed, disk(NEAR_PX)) > 0))
    tools = view & ~tissue_mask
    closed = cv2.morphologyEx((body | tools).astype(np.uint8), cv2.MORPH_CLOSE, disk(GAP_PX))
    closed = filled(closed, closed.size)
    added = closed & tissue_mask & (cv2.dilate(body.astype(np.uint8), disk(GAP_PX)) > 0)
    added = cv2.morphologyEx(added.astype(np.uint8), cv2.MORPH_OPEN, disk(2)) > 0
    entering = entering_regions((added | tools).astype(np.uint8), view) & added
    return (cv2.dilate(entering.astype(np.uint8), disk(1)) > 0) & tissue_mask


class MissedToolFinder:
    """Finds the pixels of training frames that show a tool in spite of the mask."""

    def __init__(self, sequence: FrameSequence) -> None:
        self._sequence, self._view = sequence, view_of(sequence, "train", SAMPLES)
        self._finder = ToolFinder()
        height, width = self._view.shape
        scale = WORK_PX / max(height, width)
        # (w, h), the same for a frame at full and at half resolution, which round differently.
        self._size = max(1, round(width * scale)), max(1, round(height * scale))
        self._tissue: BoundedCache[NDArray[np.bool_]] = BoundedCache(cache_bytes() // 4, lambda found: found.nbytes)

    def without_tools(self, frame: TrainingFrame, color: Tensor) -> TrainingFrame:
        """The frame without the pixels that show a missed tool; `color` (H, W, 3) is the rendered frame, in [0, 1]."""
        mask, size = frame.tissue_mask.cpu().numpy(), self._size
        rendered, target = (_resized(x.detach().cpu().numpy(), size) for x in (color, frame.rgb))
        tissue, view = (_resized_mask(x, size) for x in (mask, self._view))
        surely_tissue = self._tissue.get(frame.index, lambda: self._surely_tissue(frame.index, size))
        missed = missed_tools(rendered, target, tissue, view, surely_tissue)
        if not missed.any():
            return frame
        keep = torch.from_numpy(~_resized_mask(missed, mask.shape[::-1])).to(frame.tissue_mask.device)
        measured = frame.measured & keep
        return replace(frame, tissue_mask=frame.tissue_mask & keep, measured=measured, num_measured=int(measured.sum()))

    def share(self, frame: TrainingFrame, kept: TrainingFrame) -> float:
        """Share of the view, 0..1, that `kept`, which `without_tools` made of a frame, leaves out."""
        if kept is frame:
            return 0.0
        left_out = float((frame.tissue_mask & ~kept.tissue_mask).float().mean())
        return min(left_out / max(float(self._view.mean()), 1e-6), 1.0)

    def _surely_tissue(self, index: int, size: tuple[int, int]) -> NDArray[np.bool_]:
        """(h, w) True where the tool network is sure of tissue; `size` is (w, h)."""
        log_odds = self._finder.log_odds(self._sequence.frame(index).rgb_u8, self._view, turned=False)
        return _resized(log_odds, size) < SURELY_TISSUE


def _resized(image: NDArray, size: tuple[int, int]) -> NDArray:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_LINEAR)


def _resized_mask(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def record_visit(shares: Tensor, position: int, share: float) -> None:
    """Append the share of the view that did not count to those of a frame, (F, VISITS), and forget its oldest one."""
    shares[position] = torch.cat((shares[position, 1:], shares.new_tensor([share])))


def missed_tool_frames(shares: Tensor, indices: Sequence[int]) -> tuple[int, ...]:
    """Those of the training frames `indices` whose masks likely miss a tool, by their `shares` (F, VISITS)."""
    often = (shares > MIN_MISSED_TOOL_SHARE).sum(1) >= MIN_VISITS
    return tuple(index for index, missed in zip(indices, often.tolist(), strict=True) if missed)
