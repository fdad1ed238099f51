"""What an iteration needs of each training frame, as tensors made once: targets, masks, the prior, the frame before."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..core.types import Camera, Frame
from ..data import FrameSequence, shrunk
from ..initialization.sampling import depth_weight, has_surface
from ..initialization.unseen import convex_hull
from ..priors import Border, joint_texture_prior
from ..system.memory import BoundedCache, cache_bytes


@dataclass(frozen=True)
class TrainingFrame:
    """One training frame at one resolution."""

    index: int
    time: float  # in [0, 1)
    camera: Camera
    rgb_u8: Tensor  # (H, W, 3) uint8
    tissue_mask: Tensor  # (H, W) bool, True on tissue
    hidden: Tensor
    """(H, W) bool, True where something hides tissue: within the convex hull of `tissue_mask`, and not on it."""
    inverse_depth: Tensor  # (H, W) 1 / mm; 0 where there is no depth
    measured: Tensor  # (H, W) bool, True where tissue has a depth
    num_measured: int  # pixels of `measured`
    brightness: float  # mean color over tissue, in [0, 1]; 0 without tissue
    weight: Tensor | None = None  # (H, W) float32 in [0, 1], how far each pixel is to be believed; None: all alike
    depth_weight: Tensor | None = None  # (H, W) float32 in [0, 1], how far its depth is, see `depth_weight`; None: 1

    def counted(self, mask: Tensor) -> Tensor:
        """A mask (H, W) as the loss counts it: bool, or float32 in [0, 1] where pixels have weights."""
        return mask if self.weight is None else mask * self.weight

    @property
    def counted_depth(self) -> Tensor:
        """`measured` (H, W) as the loss counts it."""
        counted = self.counted(self.measured)
        return counted if self.depth_weight is None else counted * self.depth_weight

    @property
    def reliability(self) -> float:
        """How far the frame as a whole is to be believed, in [0, 1]."""
        return 1.0 if self.weight is None else float(self.weight.max())

    @property
    def rgb(self) -> Tensor:
        """(H, W, 3) color in [0, 1]."""
        return self.rgb_u8.float() / 255

    @property
    def depth(self) -> Tensor:
        """(H, W) mm; 0 where there is none."""
        return torch.where(self.inverse_depth > 0, 1 / self.inverse_depth.clamp(min=1e-12), 0)


DEVICE_SHARE = 0.25  # share of a device's free memory that frames may take; frames beyond it are copied at each use


class TrainingFrames:
    """Training frames of a sequence by position, built when first used, cached in memory and on the device."""

    def __init__(self, sequence: FrameSequence, border: Border = "reflect", device: torch.device | str = "cpu") -> None:
        """Args: border: of the prior. device: where tensors are returned."""
        self.sequence, self.device = sequence, torch.device(device)
        self.indices = sequence.indices("train")
        self._border: Border = border
        limits = cache_bytes(), device_bytes(self.device)
        self._frames, self._device_frames = (BoundedCache[TrainingFrame](limit, _frame_bytes) for limit in limits)
        self._priors, self._device_priors = (
            BoundedCache[Tensor](limit // 4, lambda prior: prior.nbytes) for limit in limits
        )

    def __len__(self) -> int:
        return len(self.indices)

    def frame(self, position: int, *, half: bool = False, right: bool = False) -> TrainingFrame:
        """Training frame number `position`, at full or at half width and height, of the left or the right eye."""

        def build() -> TrainingFrame:
            read = self.sequence.right_frame if right else self.sequence.frame
            return _training_frame(shrunk(read(self.indices[position]), 2 if half else 1))

        key = (position, half, right)
        if self.device.type == "cpu":
            return self._frames.get(key, build)
        return self._device_frames.get(key, lambda: _moved(self._frames.get(key, build), self.device))

    def before(self, position: int) -> TrainingFrame | None:
        """The frame just before in the sequence if it is itself a training frame (released code), else None."""
        if position > 0 and self.indices[position - 1] == self.indices[position] - 1:
            return self.frame(position - 1)
        return None

    def prior(self, position: int) -> tuple[Tensor, Tensor]:
        """rho (H, W) in [0, 1], and (H, W) True on reliable tissue, at full resolution."""

        def build() -> Tensor:
            frame = self.sequence.frame(self.indices[position])
            rho = joint_texture_prior(frame.rgb, frame.tissue_mask, border=self._border)
            if frame.weight is not None:
                rho = rho * frame.weight
            if frame.depth_confidence is not None:  # a Gaussian at a guessed depth may not lie where it is seen
                rho = rho * depth_weight(frame.depth_confidence)
            return torch.from_numpy(rho)

        if self.device.type == "cpu":
            prior = self._priors.get(position, build)
        else:
            prior = self._device_priors.get(position, lambda: _copied(self._priors.get(position, build), self.device))
        frame = self.frame(position)
        return prior, frame.tissue_mask if frame.weight is None else frame.tissue_mask & (frame.weight > 0.5)


def device_bytes(device: torch.device) -> int:
    """Memory of a device that frames may take, bytes."""
    return int(DEVICE_SHARE * torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else cache_bytes()


def _moved(frame: TrainingFrame, device: torch.device) -> TrainingFrame:
    moved = {name: _copied(getattr(frame, name), device) for name in _tensors(frame)}
    return replace(frame, **moved)


def _copied(tensor: Tensor, device: torch.device) -> Tensor:
    """A non-blocking copy on a device, from pinned memory."""
    return (tensor.pin_memory() if device.type == "cuda" else tensor).to(device, non_blocking=True)


def _training_frame(frame: Frame) -> TrainingFrame:
    depth, usable = frame.depth, has_surface(frame)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=usable)
    return TrainingFrame(
        index=frame.index,
        time=frame.time,
        camera=frame.camera,
        rgb_u8=torch.from_numpy(frame.rgb_u8),
        tissue_mask=torch.from_numpy(frame.tissue_mask),
        hidden=torch.from_numpy(convex_hull(frame.tissue_mask) & ~frame.tissue_mask),
        inverse_depth=torch.from_numpy(inverse),
        measured=torch.from_numpy(frame.tissue_mask & usable),
        num_measured=int(np.count_nonzero(frame.tissue_mask & usable)),
        brightness=float(frame.rgb_u8[frame.tissue_mask].mean()) / 255 if frame.tissue_mask.any() else 0.0,
        weight=None if frame.weight is None else torch.from_numpy(frame.weight),
        depth_weight=None if frame.depth_confidence is None else torch.from_numpy(depth_weight(frame.depth_confidence)),
    )


def _frame_bytes(frame: TrainingFrame) -> int:
    return sum(getattr(frame, name).nbytes for name in _tensors(frame))


def _tensors(frame: TrainingFrame) -> list[str]:
    """Names of the fields that are tensors."""
    return [name for name, value in vars(frame).items() if isinstance(value, Tensor)]
