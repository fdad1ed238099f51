"""The work of one iteration: deform, draw, compare, differentiate, judge, update.

All of it can be queued on a device, and recorded there: what differs between two tasks of one kind is in tensors, and
nothing asks for a value.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..compute.compiled import compiled
from ..core.config import Config
from ..core.geometry import project
from ..core.types import RenderOutput
from ..model.deformation import Offsets
from ..model.scene import offsets_at
from . import density, temporal
from .frames import TrainingFrame
from .inspector import Evidence, Inspector
from .loss_kernels import supervised_losses
from .state import Losses, TrainState

if TYPE_CHECKING:
    from collections.abc import Callable

KEPT_POSES = 1024


@dataclass(frozen=True)
class Task:
    """What one iteration looks at."""

    iteration: int | Tensor
    """1-based, within the stage; off the CPU () float64."""
    frame: TrainingFrame
    before: TrainingFrame | None
    """The frame before, where the temporal term takes part."""
    prior: Tensor | None
    """(H, W) rho of the frame at full size, where it is sampled, and"""
    prior_mask: Tensor | None
    """(H, W) bool, its tissue."""
    fine: bool
    """Whether the Gaussians are deformed."""
    sh_degree: int


class Work:
    """Does one iteration after the other on one state."""

    def __init__(
        self,
        cfg: Config,
        rasterize: Callable[..., RenderOutput],
        background: Tensor,
        inspector: Inspector,
        incomplete: Callable[[], Tensor] | None = None,
    ) -> None:
        """Prepare to work.

        Args:
            incomplete: says on the device whether a picture must be drawn again; None: never.
        """
        self.cfg, self.rasterize, self.background, self.inspector = cfg, rasterize, background, inspector
        self.incomplete = incomplete

    def __call__(self, state: TrainState, task: Task) -> Evidence:
        """Draw, compare, differentiate and update, as far as the evidence allows.

        Raises:
            Diverged: as `Inspector.judge`; gradients are left, and nothing was changed.
        """
        frame, cfg = task.frame, self.cfg
        offsets, means_before = self._deform(state, task) if task.fine else (None, None)
        splats = state.gaussians.splats(offsets, task.sh_degree)
        out = self.rasterize(
            splats,
            frame.camera,
            background=self.background,
            depth_grad_to_means=cfg.render.depth_grad_to_means,
        )
        out.means2d.retain_grad()
        terms = supervised_terms(out, frame, cfg)
        if task.before is not None:
            terms |= self._temporal_terms(state, task, splats.means, means_before, out)
        sum(terms.values()).backward()
        incomplete = self.incomplete() if self.incomplete else None
        evidence = self.inspector.judge(Losses.of(terms), state.optimizer, frame.brightness, incomplete)
        with torch.no_grad():
            self._observe(state, task, out)
            state.optimizer.step(task.iteration, self.inspector.frozen)
        return evidence

    def _deform(self, state: TrainState, task: Task) -> tuple[Offsets, Tensor | None]:
        """Offsets at the frame and, where one call gives both with gradients, centers (N, 3) at the frame before."""
        time, before = task.frame.time, task.before
        if before is None or state.field is None or self.cfg.temporal.gradient != "both":
            return offsets_at(state.gaussians, state.field, time, self.cfg), None
        means = state.gaussians["means"]
        offsets, displacement = state.field.offsets_and_displacement(means, time, before.time)
        return offsets, means + displacement

    def _temporal_terms(
        self, state: TrainState, task: Task, means: Tensor, means_before: Tensor | None, out: RenderOutput
    ) -> dict[str, Tensor]:
        """L_local of Eq. (11), weighted; nothing with few Gaussians."""
        cfg, stats = self.cfg.temporal, state.stats
        drawn = out.radii > 0
        if cfg.valid_at_both:
            drawn = density.valid_projection(out.means2d, out.radii, task.frame.tissue_mask)
        eligible = drawn & (stats.num_valid >= cfg.min_valid)
        score = stats.score(self.cfg.density.unobserved_score)
        index, weights = temporal.choose_on(score, eligible, cfg)
        if len(index) < temporal.least_points(cfg):
            return {}
        before = self.means_before(state, task.before.time, index) if means_before is None else means_before[index]
        if cfg.valid_at_both:
            kept = on_tissue(before.detach(), task.before)
            if not compiled(weights):
                weights = torch.where(kept, weights, 0)
            else:
                index, weights, before = index[kept], weights[kept], before[kept]
                if len(index) < temporal.least_points(cfg):
                    return {}
        displacement, distance = temporal.local_consistency(means[index], before, weights, cfg)
        return {
            "displacement": cfg.weight * cfg.displacement_weight * displacement,
            "distance": cfg.weight * cfg.distance_weight * distance,
        }

    def means_before(self, state: TrainState, time: float | Tensor, index: Tensor) -> Tensor:
        """(P, 3) centers of the chosen Gaussians at an earlier moment, with a gradient only if that end is trained."""
        if self.cfg.temporal.gradient == "both":
            # Moving all and then choosing is cheaper than the scattered gradient of choosing first.
            moved = state.gaussians["means"] + offsets_at(state.gaussians, state.field, time, self.cfg).means
            return moved[index]
        with torch.no_grad():
            offsets = offsets_at(state.gaussians, state.field, time, self.cfg, index)
            return state.gaussians["means"][index] + offsets.means

    def _observe(self, state: TrainState, task: Task, out: RenderOutput) -> None:
        """Feed the running statistics: the gradient always, the prior's score where there is a prior."""
        camera, frozen = task.frame.camera, self.inspector.frozen
        state.stats.add_gradient(out, camera.width, camera.height, frozen)
        if task.prior is not None:
            scale = task.prior.shape[1] / camera.width
            state.stats.add_score(out, task.prior, task.prior_mask, state.gaussians.opacities, scale, frozen)


def supervised_terms(out: RenderOutput, frame: TrainingFrame, cfg: Config) -> dict[str, Tensor]:
    """Weighted color, depth and total-variation terms of Eq. (12)."""
    depth = out.depth / out.alpha.clamp(min=1e-6) if cfg.loss.depth_mode == "expected" else out.depth
    enough = frame.num_measured >= cfg.loss.min_depth_pixels
    weights = (1.0, cfg.loss.depth_weight if enough else 0.0, cfg.loss.tv_weight)
    terms = supervised_losses(
        out.color, depth, frame.rgb_u8, frame.inverse_depth, frame.tissue_mask, frame.measured, weights
    )
    return dict(zip(("color", "depth", "tv"), terms, strict=True))


def on_tissue(points: Tensor, frame: TrainingFrame) -> Tensor:
    """(P,) bool: whether world points (P, 3) mm project in front of the camera, into the image, onto tissue."""
    if not compiled(points):
        camera = frame.camera
        view = _pose_on(camera.world_to_camera.astype(np.float32).tobytes(), points.device)
        x, y, z = (points @ view[:3, :3].T + view[:3, 3]).unbind(-1)
        means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
        return density.valid_projection(means2d, (z > 0).int(), frame.tissue_mask)
    pixels, z = project(points.numpy(), frame.camera)
    means2d, in_front = torch.from_numpy(pixels.astype(np.float32)), torch.from_numpy(z > 0).int()
    return density.valid_projection(means2d, in_front, frame.tissue_mask)


@lru_cache(maxsize=KEPT_POSES)
def _pose_on(pose: bytes, device: torch.device) -> Tensor:
    """(4, 4) float32 world to camera on a device: copied there once."""
    return torch.from_numpy(np.frombuffer(pose, np.float32).reshape(4, 4).copy()).to(device)
