"""Which pixels of a frame count in an iteration, where its tool mask was found by a program: see `missed_tools`."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.spread import spread
from ..data import FrameSequence
from ..system.memory import BoundedCache, cache_bytes
from ..tool_masks.colors import FEATURES_PX, ClipColors, first_guess
from ..tool_masks.sequence import view_of
from .frames import TrainingFrame
from .missed_tools import SURELY_TISSUE, WORK_PX, missed_tools

SAMPLES = 12
"""Frames from which the colors of the clip and the border of its view are taken."""


class MaskDoubt:
    """Takes pixels that show a tool in spite of the mask out of a training frame."""

    def __init__(self, sequence: FrameSequence) -> None:
        """Measure the colors of the training frames of `sequence`, and the border of their view."""
        indices = sequence.indices("train")
        frames = [sequence.frame(indices[k]) for k in spread(len(indices), SAMPLES)]
        self._sequence, self._view = sequence, view_of(frames)
        self._clip = ClipColors.of([frame.rgb_u8 for frame in frames], [self._view] * len(frames))
        self._tissue: BoundedCache[NDArray[np.bool_]] = BoundedCache(cache_bytes() // 4, lambda found: found.nbytes)

    def counted(self, frame: TrainingFrame, color: Tensor) -> TrainingFrame:
        """The frame without the pixels that show a missed tool.

        Args:
            color: (H, W, 3) the rendered frame, in [0, 1].
        """
        rendered, target = _resized(color.detach().cpu().numpy()), _resized(frame.rgb.cpu().numpy())
        mask = frame.tissue_mask.cpu().numpy()
        size = rendered.shape[1::-1]
        tissue, view = (
            cv2.resize(x.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for x in (mask, self._view)
        )
        surely_tissue = self._tissue.get(frame.index, lambda: self._surely_tissue(frame.index, size))
        missed = missed_tools(rendered, target, tissue, view, surely_tissue)
        if not missed.any():
            return frame
        large = cv2.resize(missed.astype(np.uint8), mask.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        keep = torch.from_numpy(~large).to(frame.tissue_mask.device)
        measured = frame.measured & keep
        return replace(frame, tissue_mask=frame.tissue_mask & keep, measured=measured, num_measured=int(measured.sum()))

    def _surely_tissue(self, index: int, size: tuple[int, int]) -> NDArray[np.bool_]:
        """(h, w) True where the color of the frame is surely that of tissue; `size` is (w, h)."""
        rgb_u8 = _resized(self._sequence.frame(index).rgb_u8, FEATURES_PX)
        view = cv2.resize(self._view.astype(np.uint8), rgb_u8.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
        return cv2.resize(first_guess(rgb_u8, view, self._clip), size, interpolation=cv2.INTER_AREA) < SURELY_TISSUE


def _resized(image: NDArray, longer_px: int = WORK_PX) -> NDArray:
    """`image` with its longer side resized to `longer_px`."""
    scale = longer_px / max(image.shape[:2])
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
