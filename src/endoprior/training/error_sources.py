"""What a trained scene keeps of its frames so that later the errors of carried points can be told."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch

from ..core.types import Frame
from ..data import FrameSequence
from ..model.scene import RenderedScene, SingleScene
from ..model.surface import render_surface
from ..model.uncertainty import CELLS

NUM_FRAMES = 8
"""Training frames, evenly spaced, whose rendered depth is compared with the measured one."""
WITHIN_ONE_DEVIATION = 0.68
"""Share of normal errors that are less than their standard deviation: far off edges do not count more for being far."""


def with_error_sources(scene: RenderedScene, sequence: FrameSequence) -> RenderedScene:
    """The scene with the tissue masks of its frames, small, and with the noise of its depth; radiance fields as given.

    Held-out frames get the mask of the nearest training frame.
    """
    if not isinstance(scene, SingleScene):
        return scene
    frames = sequence.frames("train")
    nearest = np.abs(np.arange(len(sequence))[:, None] - np.array([frame.index for frame in frames])).argmin(1)
    tissue = np.stack([small_mask(frame) for frame in frames])[nearest]
    chosen = np.unique(np.linspace(0, len(frames) - 1, NUM_FRAMES).round().astype(int))
    return replace(scene, tissue=torch.from_numpy(tissue), depth_noise=depth_noise(scene, [frames[k] for k in chosen]))


def small_mask(frame: Frame) -> np.ndarray:
    """(I, J) share of each cell of `CELLS` that is tissue, 0..255."""
    share = cv2.resize(frame.tissue_mask.astype(np.float32), CELLS[::-1], interpolation=cv2.INTER_AREA)
    return np.round(255 * share).astype(np.uint8)


def depth_noise(scene: SingleScene, frames: list[Frame]) -> float:
    """How far rendered depth is from measured depth, as a share of it: one standard deviation; 0 without any."""
    errors = [np.zeros(0)]
    for frame in frames:
        rendered = render_surface(scene, frame.time, frame.camera).depth
        both = (rendered > 0) & frame.depth_valid & frame.tissue_mask
        errors.append(np.abs(rendered[both] / frame.depth[both] - 1))
    found = np.concatenate(errors)
    return float(np.quantile(found, WITHIN_ONE_DEVIATION)) if len(found) else 0.0
