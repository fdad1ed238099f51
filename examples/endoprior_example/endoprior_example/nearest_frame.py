"""A baseline that learns nothing: each frame is the mean of the training frames nearest in time.

With 1 of them it is the nearest training frame, with many the mean image. Every method should beat both.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from endoprior.core.ranges import Checked, Positive
from endoprior.data import FrameSequence


@dataclass(frozen=True)
class Options(Checked):
    """What a spec can `set`."""

    num_frames: Positive = 1
    """Training frames to average."""


class NearestFrames:
    """Renders by looking up training frames."""

    def __init__(self, sequence: FrameSequence, num_frames: int) -> None:
        """Args: sequence: where frames are read from. num_frames: to average."""
        self.sequence, self.num_frames = sequence, num_frames

    def render(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Color (H, W, 3) in [0, 1] and depth (H, W) mm of frame `index`; a pixel counts where it shows tissue."""
        nearest = sorted(self.sequence.indices("train"), key=lambda i: (abs(i - index), i))[: self.num_frames]
        frames = [self.sequence.frame(i) for i in nearest]
        color = _mean([frame.rgb for frame in frames], [frame.tissue_mask[..., None] for frame in frames])
        depth = _mean([frame.depth for frame in frames], [frame.tissue_mask & frame.depth_valid for frame in frames])
        return color, depth


def _mean(images: list[NDArray], valid: list[NDArray[np.bool_]]) -> NDArray[np.float32]:
    """Mean over the images in which a pixel is valid; 0 where it never is."""
    total = sum(image * mask for image, mask in zip(images, valid, strict=True))
    return (total / np.maximum(sum(mask.astype(np.float32) for mask in valid), 1)).astype(np.float32)


options = Options()


def train(sequence: FrameSequence, options: Options, *, seed: int, out: Path) -> NearestFrames:
    """Nothing to train: the frames are the model."""
    return NearestFrames(sequence, options.num_frames)
