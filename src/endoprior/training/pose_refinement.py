"""Camera poses that are trained with the scene.

A pose is X W: W is the given world-to-camera transform, X the rigid transform of a twist in camera axes, one for each
training frame, which follows the gradient of the loss. Moving the Gaussians in place of the camera gives every
rasterizer the gradient of the pose: x' = W^-1 X W x. `F` training frames, `N` Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..core.config import Config
from ..core.config_poses import PoseConfig
from ..core.types import Camera, Splats
from .adam import BETA1, BETA2
from .frames import TrainingFrames
from .pose_check import FollowedCorners, corner_error_px, follow_corners
from .rates import log_linear

EPSILON = 1e-15
"""Adam's."""
TINY = 1e-8
"""Below this angle, rad, a rotation is its own first-order term."""


@dataclass
class PoseState:
    """What refinement has found so far; a checkpoint holds exactly this."""

    twists: Tensor
    """(F, 6) float64 rotation vector, rad, and translation, mm, in the camera axes of each training frame."""
    first: Tensor
    """(F, 6) Adam's first moment, ..."""
    second: Tensor
    """(F, 6) ... and its second."""
    steps: Tensor
    """(F,) int64 steps of each frame."""
    accepted: Tensor
    """(F, 6) twists that were kept last."""

    @staticmethod
    def at_start(num_frames: int) -> PoseState:
        """The given poses."""
        zeros = [torch.zeros(num_frames, 6, dtype=torch.float64) for _ in range(4)]
        return PoseState(*zeros[:3], torch.zeros(num_frames, dtype=torch.int64), zeros[3])

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name."""
        return dict(vars(self))


def rotation(vector: Tensor) -> Tensor:
    """(3, 3) rotation by a vector (3,), rad: Rodrigues' formula."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    square = (vector**2).sum()
    angle = square.clamp(min=TINY**2).sqrt()
    small = square < TINY**2
    sine = torch.where(small, 1 - square / 6, angle.sin() / angle)
    versine = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / angle**2)
    return torch.eye(3).to(vector) + sine * cross + versine * (cross @ cross)


def rigid(twist: Tensor) -> Tensor:
    """(4, 4) rigid transform of a twist (6,): the rotation by its first half, then the translation by its second."""
    upper = torch.cat([rotation(twist[:3]), twist[3:, None]], 1)
    return torch.cat([upper, torch.tensor([[0, 0, 0, 1]]).to(twist)])


def moved(splats: Splats, camera: Camera, twist: Tensor) -> Splats:
    """The Gaussians where `camera` sees them as the refined camera sees `splats`; differentiable in `twist` (6,).

    Colors that depend on the direction are looked up as if the camera had not moved: corrections are small.
    """
    pose = torch.from_numpy(np.ascontiguousarray(camera.world_to_camera))
    matrix = (torch.linalg.inv(pose) @ rigid(twist) @ pose).to(splats.means)
    return replace(
        splats,
        means=splats.means @ matrix[:3, :3].T + matrix[:3, 3],
        quats=_turned(splats.quats, matrix[:3, :3]),
    )


def _turned(quats: Tensor, matrix: Tensor) -> Tensor:
    """(N, 4) quaternions (w, x, y, z) turned by a rotation (3, 3) of less than 90 degrees."""
    w = 0.5 * torch.sqrt(1 + matrix.trace())
    axis = torch.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    axis = axis / (4 * w)
    scalar, vector = quats[:, :1], quats[:, 1:]
    new_scalar = w * scalar - (vector * axis).sum(1, keepdim=True)
    new_vector = w * vector + scalar * axis + torch.linalg.cross(axis.expand_as(vector), vector)
    return torch.cat([new_scalar, new_vector], 1)


def smoothness(twists: Tensor, position: int, twist: Tensor, cfg: PoseConfig) -> Tensor:
    """Square of how far the `twist` (6,) of a frame is from the mean of its neighbors', in units of `cfg`; ()."""
    near = [k for k in (position - 1, position + 1) if 0 <= k < len(twists)] or [position]  # alone: no pull
    unit = twists.new_tensor([cfg.turn_unit_rad] * 3 + [cfg.shift_unit_mm] * 3)
    return cfg.smooth_weight * (((twist - twists[near].mean(0)) / unit) ** 2).sum()


class PoseRefinement:
    """Trains the poses of the training frames, and undoes what held-out corners speak against."""

    def __init__(self, cameras: Sequence[Camera], frames: TrainingFrames, cfg: Config) -> None:
        """Args: cameras: of all frames, as given."""
        self._cameras, self._trained, self.cfg = cameras, frames.indices, cfg
        self._frames = frames

    @cached_property
    def _corners(self) -> list[FollowedCorners]:
        return follow_corners(self._frames)

    def step(self, state: PoseState, position: int, gradient: Tensor, iteration: int) -> None:
        """One step of Adam for the twist of one training frame; every few iterations the poses are checked.

        Args:
            position: of the frame among the training frames.
            gradient: (6,) of its twist.
            iteration: 1-based, of the fine stage.
        """
        poses, optim = self.cfg.poses, self.cfg.optim
        # On a device, a divergence is known some iterations later: it must not reach the poses.
        if iteration >= poses.start_iteration and bool(torch.isfinite(gradient).all()):
            share = log_linear(1.0, optim.basis_decay, iteration, optim.decay_iterations)
            _adam_step(state, position, gradient, poses, share)
        if iteration % poses.check_every == 0 or iteration == self.cfg.schedule.fine_iterations:
            self._check(state)

    def _check(self, state: PoseState) -> None:
        """Keep the twists, or go back to those that were kept last."""
        if self.error_px(state.twists) <= (1 + self.cfg.poses.worse) * self.error_px(state.accepted):
            state.accepted.copy_(state.twists)
            return
        state.twists.copy_(state.accepted)
        for moments in (state.first, state.second, state.steps):
            moments.zero_()

    def error_px(self, twists: Tensor) -> float:
        """Median error of held-out corners with these twists (F, 6), px; 0 without corners."""
        cameras = refined_cameras(self._cameras, self._trained, twists.numpy())
        return float(np.nan_to_num(corner_error_px(self._corners, [cameras[i] for i in self._trained])))


def _adam_step(state: PoseState, position: int, gradient: Tensor, cfg: PoseConfig, share: float) -> None:
    """`share` of the rates is left."""
    state.steps[position] += 1
    count = int(state.steps[position])
    first, second = state.first[position], state.second[position]
    first.mul_(BETA1).add_(gradient, alpha=1 - BETA1)
    second.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
    rates = gradient.new_tensor([cfg.turn_rate_rad] * 3 + [cfg.shift_rate_mm] * 3)
    direction = (first / (1 - BETA1**count)) / ((second / (1 - BETA2**count)).sqrt() + EPSILON)
    state.twists[position] -= share * rates * direction


def refined_cameras(
    cameras: Sequence[Camera], trained: Sequence[int], twists: NDArray[np.float64]
) -> tuple[Camera, ...]:
    """The cameras of all frames, refined; the twist of a frame that is not trained on lies between its neighbors'.

    Args:
        trained: (F,) indices of the training frames, ascending. twists: (F, 6) theirs.
    """
    between = np.stack([np.interp(np.arange(len(cameras)), trained, twists[:, k]) for k in range(6)], 1)
    poses = [rigid(torch.from_numpy(twist)).numpy() for twist in between]
    return tuple(
        replace(camera, world_to_camera=pose @ camera.world_to_camera)
        for camera, pose in zip(cameras, poses, strict=True)
    )
