"""The term that holds motion to the tracks that it started on, in PyTorch for any device, then in Numba for the CPU.

A Gaussian stays on the track that optical flow gave it, wherever flow really saw it. Color alone cannot tell which
point of flat tissue went where: without this term, training lets tissue slide.
`N` Gaussians, `P` tracks, `T` training frames.
"""

# pyright: reportCallIssue=false
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compute.parallel_kernels import parallel_njit
from ..core.types import Camera
from ..initialization.motion_fit import InitialMotion
from ..model.basis import spline_weights
from .frames import TrainingFrame

REFERENCE_WIDTH_PX = 640
"""Errors are in px of an image of this width, so that the weight of the term does not depend on the image size."""
HUBER_PX = 1.0  # errors beyond this count linearly: a track may be wrong
CHUNK = 1024  # Gaussians per task


@dataclass(frozen=True)
class StartTracks:
    """The tracks that the first Gaussians started on."""

    displacement: Tensor  # (T, P, 3) of the point from its source frame in each training frame, mm
    followed: Tensor  # (T, P) float, 1 where the flow found the point in a training frame and returned to it, else 0
    rows: Tensor  # (N,) int64 track of each Gaussian: its own, or that of the first Gaussian it descends from

    @staticmethod
    def along(motion: InitialMotion, times: Sequence[float]) -> StartTracks:
        """The tracks of P points, a Gaussian on each. Args: times: of the T training frames, in [0, 1]."""
        weights = [spline_weights(time, motion.coefficients.shape[1]) for time in times]
        displacement = [motion.displacement(each, position) for position, each in enumerate(weights)]
        return StartTracks(
            torch.from_numpy(np.stack(displacement).astype(np.float32)),
            torch.from_numpy(np.ascontiguousarray(motion.followed.T, np.float32)),
            torch.arange(len(motion.coefficients)),
        )

    def inherited(self, parents: Tensor) -> StartTracks:
        """The tracks of new Gaussians: (N',) `parents` are the rows of those that they were, or come from."""
        return replace(self, rows=self.rows[parents])

    def to(self, device: torch.device) -> StartTracks:
        """These tracks on a device."""
        return StartTracks(**{name: value.to(device) for name, value in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name."""
        return dict(vars(self))


def track_term(means: Tensor, offsets: Tensor, tracks: StartTracks, frame: TrainingFrame, position: int) -> Tensor:
    """Mean over the Gaussians of w h(e), times the frame's reliability, (): e is the distance to the track, h the
    pseudo-Huber penalty, w `followed`.

    Args:
        means: (N, 3) canonical centers, mm. offsets: (N, 3) their displacement at the frame, mm; gets the gradient.
        position: of the frame among the training frames.
    """
    wanted = tracks.displacement[position, tracks.rows]
    error_px = (offsets - wanted) * _px_per_mm(means.detach() + wanted, frame.camera)[:, None]
    penalty = HUBER_PX * (torch.sqrt((error_px**2).sum(1) + HUBER_PX**2) - HUBER_PX)
    return frame.reliability * (tracks.followed[position, tracks.rows] * penalty).mean()


def _px_per_mm(points: Tensor, camera: Camera) -> Tensor:
    """(N,) by how many px of an image of `REFERENCE_WIDTH_PX` a point (N, 3) moves for 1 mm; 0 behind the camera."""
    pose = torch.as_tensor(camera.world_to_camera).to(points)
    z = points @ pose[2, :3] + pose[2, 3]
    scale = camera.fx * REFERENCE_WIDTH_PX / camera.width
    return torch.where(z > 0, scale / z.clamp(min=1e-6), 0)


def track_term_numba(
    means: Tensor, offsets: Tensor, tracks: StartTracks, frame: TrainingFrame, position: int
) -> Tensor:
    """See `track_term`."""
    return _TrackTerm.apply(offsets, means.detach(), tracks, frame, position)


class _TrackTerm(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, offsets: Tensor, means: Tensor, tracks: StartTracks, frame: TrainingFrame, position: int
    ) -> Tensor:
        camera = frame.camera
        scale = camera.fx * REFERENCE_WIDTH_PX / camera.width
        moved = offsets.detach().contiguous().numpy()
        displacement, followed = tracks.displacement.numpy()[position], tracks.followed.numpy()[position]
        v_offsets, sums = np.empty_like(moved), np.zeros((len(moved) + CHUNK - 1) // CHUNK)
        _track_kernel(
            means.numpy(), moved, displacement, followed, tracks.rows.numpy(),
            camera.world_to_camera[2].astype(np.float32), np.float32(scale),
            np.float32(frame.reliability / len(moved)), v_offsets, sums,
        )  # fmt: skip
        ctx.v_offsets = torch.from_numpy(v_offsets)
        return offsets.new_tensor(sums.sum() * frame.reliability / len(moved))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_term: Tensor) -> tuple[Tensor | None, ...]:
        return v_term * ctx.v_offsets, None, None, None, None


@parallel_njit()
def _track_kernel(means, offsets, displacement, followed, rows, view_z, scale, share, v_offsets, sums):
    # One task per CHUNK Gaussians: writes v_offsets (N, 3), `share` times the gradient, and one sum of penalties.
    # displacement (P, 3) and followed (P,) are those of the frame; `view_z` (4,) turns a point into its camera z.
    one, huber = np.float32(1), np.float32(HUBER_PX)
    for task in prange(len(sums)):
        error = np.empty(3, np.float32)
        for n in range(task * CHUNK, min((task + 1) * CHUNK, len(means))):
            row = rows[n]
            v_offsets[n, :] = 0
            if followed[row] == 0:
                continue
            z = view_z[3]
            for c in range(3):
                z += view_z[c] * (means[n, c] + displacement[row, c])
            if z <= 0:
                continue
            px_per_mm, squared = scale / max(z, np.float32(1e-6)), np.float32(0)
            for c in range(3):
                error[c] = (offsets[n, c] - displacement[row, c]) * px_per_mm / huber
                squared += error[c] * error[c]
            root = np.sqrt(squared + one)
            sums[task] += followed[row] * huber * huber * (root - one)
            for c in range(3):
                v_offsets[n, c] = share * followed[row] * huber * px_per_mm * error[c] / root
