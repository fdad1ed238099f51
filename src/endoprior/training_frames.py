"""What the loop needs of each training frame, as tensors made once: targets, masks, the prior, the frame before."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .config import PriorConfig
from .data import Sequence
from .priors import joint_texture_prior
from .types import Camera, Frame


@dataclass(frozen=True)
class TrainingFrame:
    """One training frame at one resolution."""

    index: int
    time: float
    camera: Camera
    rgb_u8: Tensor
    """(H, W, 3) uint8."""
    tissue_mask: Tensor
    """(H, W) bool, True on tissue."""
    inverse_depth: Tensor
    """(H, W) 1 / mm; 0 where there is no depth."""
    measured: Tensor
    """(H, W) bool, True where tissue has a depth."""

    @property
    def rgb(self) -> Tensor:
        """(H, W, 3) color in [0, 1]."""
        return self.rgb_u8.float() / 255


class TrainingFrames:
    """Training frames of a sequence by position; built when first used and kept."""

    def __init__(self, sequence: Sequence, prior_cfg: PriorConfig) -> None:
        self.sequence = sequence
        self.indices = sequence.indices("train")
        self._prior_cfg = prior_cfg
        self._frames: dict[tuple[int, bool], TrainingFrame] = {}
        self._priors: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self.indices)

    def frame(self, position: int, *, half: bool = False) -> TrainingFrame:
        """Training frame number `position`, at full or at half width and height."""
        key = (position, half)
        if key not in self._frames:
            frame = self.sequence.frame(self.indices[position])
            self._frames[key] = _training_frame(halved(frame) if half else frame)
        return self._frames[key]

    def before(self, position: int) -> TrainingFrame | None:
        """The frame just before in the sequence if it is itself a training frame (released code), else None."""
        if position > 0 and self.indices[position - 1] == self.indices[position] - 1:
            return self.frame(position - 1)
        return None

    def prior(self, position: int) -> tuple[Tensor, Tensor]:
        """rho (H, W) in [0, 1] and the tissue mask (H, W) bool, at full resolution."""
        if position not in self._priors:
            frame = self.sequence.frame(self.indices[position])
            self._priors[position] = torch.from_numpy(
                joint_texture_prior(frame.rgb, frame.tissue_mask, self._prior_cfg)
            )
        return self._priors[position], self.frame(position).tissue_mask


def _training_frame(frame: Frame) -> TrainingFrame:
    depth = frame.depth
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    return TrainingFrame(
        index=frame.index,
        time=frame.time,
        camera=frame.camera,
        rgb_u8=torch.from_numpy(frame.rgb_u8),
        tissue_mask=torch.from_numpy(frame.tissue_mask),
        inverse_depth=torch.from_numpy(inverse),
        measured=torch.from_numpy(frame.tissue_mask & frame.depth_valid),
    )


def halved(frame: Frame) -> Frame:
    """The frame at half width and height, rounded down: colors averaged, masks and depth where all four agree."""
    height, width = frame.tissue_mask.shape[0] // 2, frame.tissue_mask.shape[1] // 2
    camera = frame.camera
    small = replace(
        camera, width=width, height=height, fx=camera.fx / 2, fy=camera.fy / 2, cx=camera.cx / 2, cy=camera.cy / 2
    )
    valid = _blocks(frame.depth_valid, height, width).all((1, 3))
    depth = _blocks(frame.depth, height, width).mean((1, 3), dtype=np.float32)
    return replace(
        frame,
        camera=small,
        rgb_u8=cv2.resize(frame.rgb_u8[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA),
        tissue_mask=_blocks(frame.tissue_mask, height, width).all((1, 3)),
        depth=np.where(valid, depth, np.float32(0)),
        depth_valid=valid,
    )


def _blocks(image: NDArray, height: int, width: int) -> NDArray:
    return image[: 2 * height, : 2 * width].reshape(height, 2, width, 2)
