"""Which pixels of a frame count in an iteration, where its tool mask was found by a program: see `missed_tools`."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.ranges import spread
from ..data import FrameSequence
from ..system.memory import BoundedCache, cache_bytes
from ..tool_masks import ToolFinder
from ..tool_masks.sequence import view_of
from .frames import TrainingFrame
from .missed_tools import SURELY_TISSUE, WORK_PX, missed_tools

SAMPLES = 12
"""Frames from which the border of the view is taken."""


class MaskDoubt:
    """Takes pixels that show a tool in spite of the mask out of a training frame."""

    def __init__(self, sequence: FrameSequence) -> None:
        """Find the border of the view in the training frames of `sequence`."""
        indices = sequence.indices("train")
        frames = [sequence.frame(indices[k]) for k in spread(len(indices), SAMPLES)]
        self._sequence, self._view = sequence, view_of(frames)
        self._finder = ToolFinder()
        self._tissue: BoundedCache[NDArray[np.bool_]] = BoundedCache(cache_bytes() // 4, lambda found: found.nbytes)

    def counted(self, frame: TrainingFrame, color: Tensor) -> TrainingFrame:
        """The frame without the pixels that show a missed tool.

        Args:
            color: (H, W, 3) the rendered frame, in [0, 1].
        """
        mask, size = frame.tissue_mask.cpu().numpy(), self._size(WORK_PX)
        rendered, target = (_resized(x.detach().cpu().numpy(), size) for x in (color, frame.rgb))
        tissue, view = (_resized_mask(x, size) for x in (mask, self._view))
        surely_tissue = self._tissue.get(frame.index, lambda: self._surely_tissue(frame.index, size))
        missed = missed_tools(rendered, target, tissue, view, surely_tissue)
        if not missed.any():
            return frame
        keep = torch.from_numpy(~_resized_mask(missed, mask.shape[::-1])).to(frame.tissue_mask.device)
        measured = frame.measured & keep
        return replace(frame, tissue_mask=frame.tissue_mask & keep, measured=measured, num_measured=int(measured.sum()))

    def share(self, frame: TrainingFrame, counted: TrainingFrame) -> float:
        """Share of the view, 0..1, that `counted` leaves out of the frame from which it was made."""
        if counted is frame:
            return 0.0
        left_out = float((frame.tissue_mask & ~counted.tissue_mask).float().mean())
        return min(left_out / max(float(self._view.mean()), 1e-6), 1.0)

    def _surely_tissue(self, index: int, size: tuple[int, int]) -> NDArray[np.bool_]:
        """(h, w) True where the tool network is sure of tissue; `size` is (w, h)."""
        log_odds = self._finder.log_odds(self._sequence.frame(index).rgb_u8, self._view, mirrored=False)
        return _resized(log_odds, size) < SURELY_TISSUE

    def _size(self, longer_px: int) -> tuple[int, int]:
        """(w, h) with that longer side: one for a frame at full and at half resolution, which round differently."""
        height, width = self._view.shape
        scale = longer_px / max(height, width)
        return max(1, round(width * scale)), max(1, round(height * scale))


def _resized(image: NDArray, size: tuple[int, int]) -> NDArray:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_LINEAR)


def _resized_mask(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
