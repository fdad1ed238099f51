"""One training iteration, from the choice of a frame to the update: `TrainingStep.__call__` and `compare` show it."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ..core.config import Config
from ..core.types import RenderOutput, Splats
from ..model.deformation import HexPlaneField, Offsets
from ..render import Rasterizer
from . import density, left_out
from .densify import apply_plan, reset_opacities
from .divergence import ADVICE, Diverged, DivergenceCheck
from .drawn import Drawn
from .frames import TrainingFrame, TrainingFrames
from .gaussians_state import GaussiansState
from .losses_torch import color_l1
from .mask_doubt import MaskDoubt
from .missed_tools import START
from .ops import TrainingOps
from .scale_limit import limit_scales
from .stage import Stage, StepReport, stage_length
from .temporal import temporal_terms
from .track_loss import track_term

if TYPE_CHECKING:
    from .gaussian_method import GaussianMethod


RESET_OPACITY = 0.01
"""Where methods that reset opacities lower them to (3DGS)."""


@dataclass(frozen=True)
class Batch:
    """The data of one iteration: one frame, and what the terms of the loss need beside it."""

    frame: TrainingFrame
    position: int
    """Its place among the training frames."""
    before: TrainingFrame | None
    """The frame before, where the temporal term takes part."""
    prior: Tensor | None
    """(H, W) rho of the frame at full resolution, where it is sampled, and"""
    prior_mask: Tensor | None
    """(H, W) bool, its tissue."""


@dataclass(frozen=True)
class Compared:
    """The forward pass of one iteration."""

    iteration: int
    rng: np.random.Generator
    """Of this iteration."""
    batch: Batch
    splats: Splats
    """The Gaussians at the frame."""
    out: RenderOutput
    terms: dict[str, Tensor]
    """Weighted terms of the loss, () each."""
    color_error: Tensor
    """() mean absolute color error over tissue, which the divergence check watches."""
    left_out: float | None
    """Share of the view that does not count because it shows a missed tool; None where that was not asked."""


@dataclass
class TrainingStep:
    """Does one iteration after the other. What it needs beside the state does not change while training.

    Every random choice is a pure function of (seed, stage, iteration), so a resumed run repeats an uninterrupted one.
    """

    method: GaussianMethod
    cfg: Config
    frames: TrainingFrames
    camera_centers: Tensor
    """(T, 3) camera positions of the training frames, mm."""
    rasterize: Rasterizer
    ops: TrainingOps
    check: DivergenceCheck
    doubt: MaskDoubt | None = None
    """Takes missed tools out of the frames; None trusts the masks."""
    background: Tensor = field(default_factory=lambda: torch.zeros(3))
    """(3,) color behind everything."""

    @cached_property
    def context(self) -> Any:
        """See `GaussianMethod.context`."""
        return self.method.context(self.frames, self.cfg)

    def __call__(self, state: GaussiansState) -> StepReport:
        """Deform, render, compare, differentiate, check, update, then grow or prune.

        Where the report has a `divergence`, the state is the one after the last good iteration.

        Raises:
            Diverged: no Gaussian is left, or a split would give one of infinite size. The state is then the one before
                density control.
        """
        began = clock.perf_counter()
        done = self.compare(state)
        sum(done.terms.values()).backward()

        fine, last = state.stage is Stage.FINE, done.iteration == stage_length(self.cfg, state.stage)
        densify = self.method.density_due(state.stage, done.iteration, last, self.cfg)
        # After the last iteration nothing would train the lowered opacities again.
        reset = self.method.reset_due(state.stage, done.iteration, self.cfg) and not (fine and last)
        divergence = self.check.after_backward(
            done.iteration,
            done.terms,
            state.optimizer.count_unusable(),
            done.color_error,
            self.method.empty_error(done.batch.frame.brightness),
            wait=densify or reset or last,
        )
        event: dict[str, int] | None = None
        if divergence is not None:
            state.optimizer.drop_gradients()
            state.iteration = divergence.last_good
        else:
            with torch.no_grad():
                event = self._update(state, done, densify, reset)
        losses = {name: value.detach() for name, value in done.terms.items()}
        seconds = clock.perf_counter() - began
        missed = None
        if fine and last and state.left_out is not None:
            missed = left_out.missed_tool_frames(state.left_out, self.frames.indices)
        return StepReport(state.stage, done.iteration, losses, len(state.gaussians), seconds, event, divergence, missed)

    def compare(self, state: GaussiansState) -> Compared:
        """The forward pass of the next iteration, up to the terms of the loss; nothing is changed."""
        cfg, iteration, fine = self.cfg, state.iteration + 1, state.stage is Stage.FINE
        rng = np.random.default_rng([cfg.seed, int(state.stage), iteration])
        position = self.method.position(cfg.seed, state.stage, iteration, len(self.frames), rng)
        right = fine and cfg.data.eyes == "both" and rng.random() < 0.5
        batch = self._right_batch(iteration, position) if right else self._batch(iteration, position, fine)

        splats, offsets, means_before = self._deform(state, batch, iteration)
        draw = partial(
            self.rasterize,
            camera=batch.frame.camera,
            background=self.background,
            depth_grad_to_means=cfg.render.depth_grad_to_means,
        )
        out = draw(splats)
        out.means2d.retain_grad()
        counted, share = batch.frame, None
        if self.doubt and fine and not right and iteration > START * stage_length(cfg, Stage.FINE):
            counted = self.doubt.counted(counted, out.color)
            share = self.doubt.share(batch.frame, counted)
        drawn = Drawn(
            stage=state.stage,
            iteration=iteration,
            position=position,
            frame=counted,
            gaussians=state.gaussians,
            field=state.field,
            offsets=offsets,
            splats=splats,
            out=out,
            draw=draw,
            context=self.context,
        )
        terms = self.method.terms(drawn, cfg, self.ops)
        color_error = (
            terms["color"]
            if self.method.color_is_error
            else color_l1(out.color.detach(), counted.rgb, counted.tissue_mask)
        )
        if offsets is not None and state.tracks is not None:
            terms |= self._track_terms(state, batch, offsets)
        if batch.before is not None:
            terms |= temporal_terms(state, batch.frame, batch.before, splats.means, means_before, out, cfg, self.ops)
        return Compared(iteration, rng, batch, splats, out, terms, color_error, share)

    def _update(self, state: GaussiansState, done: Compared, densify: bool, reset: bool) -> dict[str, int] | None:
        """Apply the gradients of an iteration, then grow or prune; what density control did, if it did anything."""
        cfg, batch, event = self.cfg, done.batch, None
        self._observe(state, batch, done.out)
        if state.left_out is not None and done.left_out is not None:
            left_out.record(state.left_out, batch.position, done.left_out)
        state.optimizer.step(done.iteration, self.check.skip)
        if cfg.density.max_scale_share:
            log_scales = state.gaussians["log_scales"].detach()
            limit_scales(log_scales, done.splats.means, batch.frame.camera, cfg.density.max_scale_share)
        state.iteration = done.iteration  # what follows may raise, and must leave a state that can be resumed
        if densify:
            event = self._densify(state, done.iteration, done.rng)
        if reset:
            reset_opacities(state.optimizer, RESET_OPACITY)
        return event

    def _batch(self, iteration: int, position: int, fine: bool) -> Batch:
        """Training frame number `position`, at half resolution early in the fine stage."""
        cfg = self.cfg
        compared = fine and cfg.temporal.weight > 0 and iteration >= cfg.temporal.start_iteration
        sampled = cfg.density.score_mode == "every" or density.due(iteration, False, cfg.density)
        sampled &= self.method.uses_prior
        prior, prior_mask = self.frames.prior(position) if sampled else (None, None)
        return Batch(
            position=position,
            frame=self.frames.frame(position, half=fine and iteration <= cfg.schedule.half_resolution_iterations),
            before=self.frames.before(position) if compared else None,
            prior=prior,
            prior_mask=prior_mask,
        )

    def _right_batch(self, iteration: int, position: int) -> Batch:
        """The right eye of training frame number `position`: only its picture and depth are compared."""
        half = iteration <= self.cfg.schedule.half_resolution_iterations
        return Batch(self.frames.frame(position, half=half, right=True), position, None, None, None)

    def _deform(
        self, state: GaussiansState, batch: Batch, iteration: int
    ) -> tuple[Splats, Offsets | None, Tensor | None]:
        """The Gaussians at the frame, what moved them, and (N, 3) centers at the frame before if known already."""
        gaussians, field, time, before = state.gaussians, state.field, batch.frame.time, batch.before
        offsets: Offsets | None = None
        means_before = None
        motion = self.method.motion(self.cfg)
        if state.stage is Stage.FINE:
            if before is None or self.cfg.temporal.gradient != "both" or not isinstance(field, HexPlaneField):
                offsets = motion.offsets(gaussians, field, time, self.cfg, self.ops.model)
            else:
                offsets, displacement = field.offsets_and_displacement(
                    gaussians["means"], time, before.time, self.ops.model
                )
                means_before = gaussians["means"] + displacement
        return gaussians.splats(offsets, sh_degree(self.cfg, state.stage, iteration)), offsets, means_before

    def _track_terms(self, state: GaussiansState, batch: Batch, offsets: Offsets) -> dict[str, Tensor]:
        means, basis = state.gaussians["means"], self.cfg.deformation.basis
        term = track_term(means, offsets.means, state.tracks, batch.frame, batch.position, basis, self.ops)
        return {"track": self.cfg.loss.track_weight * term}

    def _observe(self, state: GaussiansState, batch: Batch, out: RenderOutput) -> None:
        """Add to the running statistics: the gradient always, the prior's score where there is a prior."""
        camera, skip = batch.frame.camera, self.check.skip
        self.ops.add_gradient(state.stats, out, camera.width, camera.height, skip)
        if batch.prior is not None:
            scale = batch.prior.shape[1] / camera.width
            opacities = state.gaussians.opacities
            self.ops.add_score(state.stats, out, batch.prior, batch.prior_mask, opacities, scale, skip)

    def _densify(self, state: GaussiansState, iteration: int, rng: np.random.Generator) -> dict[str, int]:
        gaussians = state.gaussians
        extent = density.scene_extent(self.camera_centers, gaussians["means"], self.cfg.density)
        planned = self.method.plan(state.stats, gaussians, extent, state.stage, iteration, self.cfg)
        if bool(planned.remove.all()):
            lost = f"after iteration {iteration} all {len(planned.remove):,} faded"
            raise Diverged(f"expected Gaussians that explain the frames; {lost}. {ADVICE}")
        state.stats, parents = apply_plan(state.optimizer, planned, state.stats, rng)
        state.tracks = state.tracks and state.tracks.inherited(parents)
        return planned.counts()


def sh_degree(cfg: Config, stage: Stage, iteration: int) -> int:
    """Degree of color in use: +1 per `sh_every` iterations of each stage, never falling back (method of 3DGS)."""
    done = iteration // cfg.schedule.sh_every
    if stage is Stage.FINE:
        done += cfg.schedule.coarse_iterations // cfg.schedule.sh_every
    return min(done, cfg.schedule.sh_degree)
