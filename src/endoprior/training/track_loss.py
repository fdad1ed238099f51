"""Tracks as supervision: a Gaussian stays on the track that optical flow gave it, wherever flow really saw it.

Color alone cannot tell which point of flat tissue went where: without this term, training lets tissue slide.
`N` Gaussians, `P` tracks, `T` training frames, `B` basis functions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..core.config_deformation import BasisConfig
from ..core.types import Camera
from ..model.motion import basis_weights
from .frames import TrainingFrame
from .ops import TrainingOps

REFERENCE_WIDTH_PX = 640
"""Errors are in px of an image of this width, so that the weight of the term does not depend on the image size."""
HUBER_PX = 1.0
"""Errors beyond this count linearly: a track may be wrong."""


@dataclass(frozen=True)
class StartTracks:
    """The tracks that the first Gaussians started on."""

    coefficients: Tensor
    """(P, B, 3) motion from the point's source frame, mm."""
    followed: Tensor
    """(P, T) float, 1 where the flow found the point in a training frame and returned to it, else 0."""
    rows: Tensor
    """(N,) int64 track of each Gaussian: its own, or that of the first Gaussian it descends from."""

    @staticmethod
    def of_first(coefficients: Tensor, followed: Tensor) -> StartTracks:
        """Each Gaussian has its own track."""
        return StartTracks(coefficients, followed, torch.arange(len(coefficients), device=coefficients.device))

    def inherited(self, parents: Tensor) -> StartTracks:
        """The tracks of new Gaussians: (N',) `parents` are the rows of those that they were, or come from."""
        return replace(self, rows=self.rows[parents])

    def to(self, device: torch.device) -> StartTracks:
        """These tracks on a device."""
        return StartTracks(**{name: value.to(device) for name, value in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name."""
        return dict(vars(self))


def track_term(
    means: Tensor,
    offsets: Tensor,
    tracks: StartTracks,
    frame: TrainingFrame,
    position: int,
    cfg: BasisConfig,
    ops: TrainingOps,
) -> Tensor:
    """Mean over the Gaussians of w h(e), (): e is the distance to the track, h the pseudo-Huber penalty, w `followed`.

    Args:
        means: (N, 3) canonical centers, mm. offsets: (N, 3) their displacement at the frame, mm; gets the gradient.
        position: of the frame among the training frames.
    """
    wanted = ops.model.weighted_sum(tracks.coefficients, basis_weights(frame.time, cfg))[tracks.rows]
    error_px = (offsets - wanted) * _px_per_mm(means.detach() + wanted, frame.camera)[:, None]
    penalty = HUBER_PX * (torch.sqrt((error_px**2).sum(1) + HUBER_PX**2) - HUBER_PX)
    return (tracks.followed[tracks.rows, position] * penalty).mean()


def _px_per_mm(points: Tensor, camera: Camera) -> Tensor:
    """(N,) by how many px of an image of `REFERENCE_WIDTH_PX` a point (N, 3) moves for 1 mm; 0 behind the camera."""
    pose = torch.as_tensor(camera.world_to_camera).to(points)
    z = points @ pose[2, :3] + pose[2, 3]
    scale = camera.fx * REFERENCE_WIDTH_PX / camera.width
    return torch.where(z > 0, scale / z.clamp(min=1e-6), 0)
