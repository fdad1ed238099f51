"""The terms of Eq. (12) that compare one rendered image with its frame, and the term that holds motion to its tracks.

Tracks are supervision too: a Gaussian stays on the track that optical flow gave it, wherever flow really saw it. Color
alone cannot tell which point of flat tissue went where: without this term, training lets tissue slide.
`N` Gaussians, `P` tracks, `T` training frames, `B` basis functions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..core.config import LossConfig
from ..core.config_deformation import BasisConfig
from ..core.types import Camera, RenderOutput
from ..model.motion import basis_weights
from .frames import TrainingFrame

if TYPE_CHECKING:
    from .ops import TrainingOps


def color_l1(color: Tensor, target: Tensor, tissue_mask: Tensor) -> Tensor:
    """L_rgb: mean absolute difference of (H, W, 3) colors over tissue pixels (H, W) and channels."""
    count = (tissue_mask.sum() * color.shape[-1]).clamp(min=1)
    return ((color - target).abs() * tissue_mask[..., None]).sum() / count


def edge_l1(color: Tensor, target: Tensor, tissue_mask: Tensor) -> Tensor:
    """L_edge: absolute difference of image gradients, summed over both axes, mean over tissue pixels and channels.

    Gradients are forward differences between two pixels of tissue, as in the gradient difference loss of Mathieu
    et al. 2016, but of gradients with their signs.
    """
    error = color - target
    down = (error[1:] - error[:-1]).abs() * (tissue_mask[1:] & tissue_mask[:-1])[..., None]
    right = (error[:, 1:] - error[:, :-1]).abs() * (tissue_mask[:, 1:] & tissue_mask[:, :-1])[..., None]
    return (down.sum() + right.sum()) / (tissue_mask.sum() * color.shape[-1]).clamp(min=1)


def inverse_depth(depth: Tensor) -> Tensor:
    """1 / depth where depth is not 0, else 0; same shape, 1 / mm."""
    rendered = depth != 0
    return torch.where(rendered, 1 / torch.where(rendered, depth, 1), 0)


def inverse_depth_l1(inverse: Tensor, target: Tensor, measured: Tensor) -> Tensor:
    """L_depth: mean absolute difference of inverse depths (H, W) over `measured` tissue pixels, 1 / mm."""
    return ((inverse - target).abs() * measured).sum() / measured.sum().clamp(min=1)


def total_variation(image: Tensor, left_out: Tensor | None = None) -> Tensor:
    """Sum of absolute forward differences of (H, W) or (H, W, C) along both axes, divided by the number of values.

    Differences between two pixels of `left_out` (H, W) do not count.
    """
    down, right = (image[1:] - image[:-1]).abs(), (image[:, 1:] - image[:, :-1]).abs()
    if left_out is not None:
        shape = (*left_out.shape, *[1] * (image.ndim - 2))
        counted = ~left_out.reshape(shape)
        down, right = down * (counted[1:] | counted[:-1]), right * (counted[:, 1:] | counted[:, :-1])
    return (down.sum() + right.sum()) / image.numel()


def supervised_losses(
    color: Tensor,
    depth: Tensor,
    target_u8: Tensor,
    target_inverse: Tensor,
    tissue_mask: Tensor,
    measured: Tensor,
    weights: tuple[float, float, float, float],
    tv_on_tissue: bool = True,
) -> Tensor:
    """Weighted color, depth, total-variation and edge terms.

    Args:
        color: (H, W, 3) float32. depth: (H, W) float32 mm, 0 where nothing is rendered.
        target_u8: (H, W, 3) uint8. target_inverse: (H, W) 1 / mm.
        tissue_mask, measured: (H, W) bool, True where color, respectively depth, is compared.
        weights: factors of the four terms; the depth term is 0 where its factor is.
        tv_on_tissue: whether the total variation counts between two pixels of tissue.
    Returns:
        (4,) the weighted terms, differentiable in `color` and `depth`.
    """
    inverse, left_out = inverse_depth(depth), None if tv_on_tissue else tissue_mask
    target = target_u8.float() / 255
    terms = [
        color_l1(color, target, tissue_mask),
        inverse_depth_l1(inverse, target_inverse, measured),
        total_variation(color, left_out) + total_variation(inverse, left_out),
        edge_l1(color, target, tissue_mask),
    ]
    return torch.stack([weight * term for weight, term in zip(weights, terms, strict=True)])


def supervised_terms(out: RenderOutput, frame: TrainingFrame, cfg: LossConfig, ops: TrainingOps) -> dict[str, Tensor]:
    """Weighted color, depth, total-variation and edge terms, and that of what is hidden, () each."""
    depth = out.depth / out.alpha.clamp(min=1e-6) if cfg.depth_mode == "expected" else out.depth
    depth_weight = cfg.depth_weight if frame.num_measured >= cfg.min_depth_pixels else 0.0
    fused = ops.supervised_losses(
        out.color,
        depth,
        frame.rgb_u8,
        frame.inverse_depth,
        frame.tissue_mask,
        frame.measured,
        (1.0, depth_weight, cfg.tv_weight, cfg.edge_weight),
        cfg.tv_on_tissue,
    )
    names: list[str] = ["color", "depth", "tv", "edges"]
    terms = dict(zip(names, fused, strict=True))
    if cfg.cover_weight:
        terms["cover"] = cfg.cover_weight * ((1 - out.alpha) * frame.hidden).mean()
    return terms


REFERENCE_WIDTH_PX = 640
"""Errors are in px of an image of this width, so that the weight of the term does not depend on the image size."""
HUBER_PX = 1.0  # errors beyond this count linearly: a track may be wrong


@dataclass(frozen=True)
class StartTracks:
    """The tracks that the first Gaussians started on."""

    coefficients: Tensor  # (P, B, 3) motion from the point's source frame, mm
    followed: Tensor  # (P, T) float, 1 where the flow found the point in a training frame and returned to it, else 0
    rows: Tensor  # (N,) int64 track of each Gaussian: its own, or that of the first Gaussian it descends from

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
