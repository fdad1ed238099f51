"""One training iteration: batch, deform, render, loss, backward, check, observe, update, density
(`TrainingStep.__call__`)."""

from __future__ import annotations

import math
import time as clock
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..core.checks import input_error
from ..core.config import Config
from ..core.types import Camera
from ..model.hexplane_field import HexPlaneField
from ..model.motion import Motion
from ..model.photometric import add_smoke
from ..render import Rasterizer
from . import density
from .divergence import ADVICE, Diverged, DivergenceCheck
from .frames import TrainingFrames
from .gaussian_hooks import GaussianHooks
from .losses import color_l1
from .missed_tools import START, MissedToolFinder, missed_tool_frames, record_visit
from .ops import TrainingOps
from .state import Before, ForwardPass, GaussiansState
from .temporal import temporal_terms
from .trainer import Stage, StepReport, stage_length

RESET_OPACITY = 0.01  # where methods that reset opacities lower them to (3DGS)
MAX_SCALE_SHARE = 0.016
"""Largest canonical scale as a share of the distance to the camera: larger ones are fog when the model is turned, much
smaller ones leave holes beside silhouettes."""


@dataclass
class TrainingStep:
    """Does one iteration after the other. What it needs beside the state does not change while training.

    Every random choice is a pure function of (seed, stage, iteration), so a resumed run repeats an uninterrupted one.
    """

    method: GaussianHooks
    motion: Motion  # that of the method
    cfg: Config
    frames: TrainingFrames
    extent: float  # see `density.scene_extent`
    rasterize: Rasterizer
    ops: TrainingOps
    check: DivergenceCheck
    missed_tools: MissedToolFinder | None  # None: the masks are trusted
    background: Tensor  # (3,) color behind everything
    smoke: Tensor | None = None  # (F, I, J, 2) of each training frame: see `model.photometric`; None: no smoke

    @cached_property
    def context(self) -> Any:
        """See `GaussianHooks.context`."""
        return self.method.context(self.frames, self.cfg)

    def __call__(self, state: GaussiansState) -> StepReport:
        """One iteration.

        Raises:
            Diverged: the loss or a gradient is not finite, or the images show nothing: the state is then the one after
                the last good iteration. Or no Gaussian is left, or a split would give one of infinite size: the state
                is then the one before density control.
        """
        began, cfg, method, iteration = clock.perf_counter(), self.cfg, self.method, state.iteration + 1
        rng = np.random.default_rng([cfg.seed, int(state.stage), iteration])
        fine, last = state.stage is Stage.FINE, iteration == stage_length(cfg, state.stage)
        densify = method.density_due(state.stage, iteration, last, cfg)
        # After the last iteration nothing would train the lowered opacities again.
        reset = method.reset_due(state.stage, iteration, cfg) and not (fine and last)

        forward = self.forward(state, rng)
        terms, color_error = self.loss(state, forward)
        loss = sum(terms.values(), torch.zeros(()))
        loss.backward()
        unusable, empty_error = state.optimizer.count_unusable(), method.empty_error(forward.frame.brightness)
        wait = densify or reset or last
        try:
            self.check.after_backward(iteration, terms, unusable, color_error, empty_error, wait=wait)
        except Diverged as error:
            state.optimizer.drop_gradients()
            state.iteration = error.last_good
            raise
        event: dict[str, int] | None = None
        with torch.no_grad():
            self._observe(state, forward)
            self._update(state, forward)
            state.iteration = iteration  # what follows may raise, and must leave a state that can be resumed
            if densify:
                event = self._densify(state, iteration, rng)
            if reset:
                density.reset_opacities(state.optimizer, RESET_OPACITY)
        losses = {name: value.detach() for name, value in terms.items()}
        seconds = clock.perf_counter() - began
        missed = None
        if fine and last and state.left_out is not None:
            missed = missed_tool_frames(state.left_out, self.frames.indices)
        return StepReport(state.stage, iteration, losses, len(state.gaussians), seconds, event, missed)

    def forward(self, state: GaussiansState, rng: np.random.Generator) -> ForwardPass:
        """Batch, deform, render; nothing is changed.

        Args:
            rng: that of the iteration, from which the splits of density control are drawn later.
        """
        cfg, iteration, fine = self.cfg, state.iteration + 1, state.stage is Stage.FINE
        position = self.method.position(cfg, state.stage, iteration, len(self.frames), rng)
        is_right = fine and cfg.data.eyes == "both" and rng.random() < 0.5
        half = fine and iteration <= cfg.schedule.half_resolution_iterations
        frame = self.frames.frame(position, half=half, right=is_right)
        frame_before = None
        if fine and not is_right and cfg.temporal.weight > 0 and iteration >= cfg.temporal.start_iteration:
            frame_before = self.frames.before(position)

        gaussians, model_ops, offsets, means_before = state.gaussians, self.ops.model, None, None
        if fine and frame_before and cfg.temporal.gradient == "both" and isinstance(state.field, HexPlaneField):
            # Both times at once: the planes are read once for what they share.
            means = gaussians["means"]
            offsets, displacement = state.field.offsets_and_displacement(
                means, frame.time, frame_before.time, model_ops
            )
            means_before = means + displacement
        elif fine:
            offsets = self.motion.offsets(gaussians, state.field, frame.time, cfg, model_ops)
        splats = gaussians.splats(offsets, sh_degree(cfg, state.stage, iteration), float(is_right))

        render = partial(
            self.rasterize,
            camera=frame.camera,
            background=self.background,
            depth_grad_to_means=cfg.render.depth_grad_to_means,
        )
        out = render(splats)
        out.means2d.retain_grad()  # density control grows where this gradient is large
        if self.smoke is not None:
            out = replace(out, color=add_smoke(out.color, self.smoke[position]))
        compared, left_out = frame, None
        if self.missed_tools and fine and not is_right and self._knows_tissue(state):
            compared = self.missed_tools.without_tools(frame, out.color)
            left_out = self.missed_tools.share(frame, compared)
        return ForwardPass(
            stage=state.stage,
            iteration=iteration,
            position=position,
            frame=compared,
            gaussians=gaussians,
            field=state.field,
            offsets=offsets,
            splats=splats,
            out=out,
            render=render,
            context=self.context,
            before=Before(frame_before, frame.tissue_mask, means_before) if frame_before else None,
            is_right=is_right,
            left_out=left_out,
        )

    def _knows_tissue(self, state: GaussiansState) -> bool:
        """Whether the scene explains resting tissue; once begun, it stays so in a longer training."""
        late = state.iteration + 1 > START * stage_length(self.cfg, Stage.FINE)
        return late or (state.left_out is not None and bool(state.left_out.any()))

    def loss(self, state: GaussiansState, forward: ForwardPass) -> tuple[dict[str, Tensor], Tensor]:
        """Weighted terms, () each; and the mean absolute color error over tissue, (), that the check watches."""
        cfg, frame = self.cfg, forward.frame
        terms = self.method.terms(forward, cfg, self.ops)  # ours: `losses.supervised_terms`
        _check_terms(terms, cfg)
        is_error = self.method.color_is_error
        error = terms["color"] if is_error else color_l1(forward.out.color.detach(), frame.rgb, frame.tissue_mask)
        if forward.offsets is not None and state.tracks is not None:
            means, moved = forward.gaussians["means"], forward.offsets.means
            term = self.ops.track_term(means, moved, state.tracks, frame, forward.position)
            terms |= {"track": cfg.loss.track_weight * term}
        if forward.before is not None:
            terms |= temporal_terms(forward, forward.before, self.motion, state.stats, cfg, self.ops)
        return terms, error

    def _observe(self, state: GaussiansState, forward: ForwardPass) -> None:
        """Add to the running statistics: the gradient always, the prior's score where it is sampled."""
        camera, skip, cfg = forward.frame.camera, self.check.skip, self.cfg.density
        self.ops.add_gradient(state.stats, forward.out, camera.width, camera.height, skip)
        sampled = not self.cfg.released.prior or density.due(forward.iteration, False, cfg)
        if sampled and self.method.uses_prior and not forward.is_right:
            prior, tissue_mask = self.frames.prior(forward.position)
            scale, opacities = prior.shape[1] / camera.width, state.gaussians.opacities
            self.ops.add_score(state.stats, forward.out, prior, tissue_mask, opacities, scale, skip)
        if state.left_out is not None and forward.left_out is not None:
            record_visit(state.left_out, forward.position, forward.left_out)

    def _update(self, state: GaussiansState, forward: ForwardPass) -> None:
        """Apply the gradients."""
        state.optimizer.step(forward.iteration, self.check.skip)
        if self.cfg.deformation.max_scale_change > 1:
            log_scales = state.gaussians["log_scales"].detach()
            camera, init = forward.frame.camera, self.cfg.init
            limit_scales(log_scales, forward.splats.means, camera, largest_share(camera, init.budget), init.thickness)

    def _densify(self, state: GaussiansState, iteration: int, rng: np.random.Generator) -> dict[str, int]:
        planned = self.method.plan(state.stats, state.gaussians, self.extent, state.stage, iteration, self.cfg)
        if bool(planned.remove.all()):
            lost = f"after iteration {iteration} all {len(planned.remove):,} were removed"
            raise Diverged(f"expected Gaussians that explain the frames; {lost}. {ADVICE}")
        state.stats, parents = density.apply_plan(state.optimizer, planned, state.stats, rng)
        state.tracks = state.tracks and state.tracks.inherited(parents)
        return planned.counts()


def _check_terms(terms: dict[str, Tensor], cfg: Config) -> None:
    """Raise InputError unless a method's terms are tensors (), with other names than those that training adds."""
    added = {"track"} if cfg.loss.track_weight and cfg.init.motion == "flow" else set()
    added |= {"displacement", "distance"} if cfg.temporal.weight else set()
    for name, term in terms.items():
        if not isinstance(term, Tensor) or term.ndim:
            got = f"shape {tuple(term.shape)}" if isinstance(term, Tensor) else f"a {type(term).__name__}"
            raise input_error(f"loss term {name}", "a tensor of shape ()", got, "Return its mean or its sum.")
        if name in added:
            raise input_error(f"loss term {name}", "a name of its own", "that of a built-in term", "Rename it.")


def sh_degree(cfg: Config, stage: Stage, iteration: int) -> int:
    """Degree of color in use: +1 per `sh_every` iterations of each stage, never falling back (method of 3DGS)."""
    done = iteration // cfg.schedule.sh_every
    if stage is Stage.FINE:
        done += cfg.schedule.coarse_iterations // cfg.schedule.sh_every
    return min(done, cfg.schedule.sh_degree)


def largest_share(camera: Camera, num_first: int) -> float:
    """Largest canonical scale as a share of the distance to `camera`: max(`MAX_SCALE_SHARE`, sqrt(W H / N) / fx).

    The second is the spacing of N Gaussians that fill the image of W x H px; smaller ones would leave holes.

    Args:
        num_first: N, the number of first Gaussians, above 0.
    """
    spacing_px = math.sqrt(camera.width * camera.height / num_first)
    return max(MAX_SCALE_SHARE, spacing_px / camera.fx)


def limit_scales(log_scales: Tensor, means: Tensor, camera: Camera, share: float, thickness: float = 1.0) -> None:
    """Lower `log_scales` in place: to the log of `share` of the distance to the camera, and to flat ones.

    A Gaussian that spans much of the picture, or is long where the camera looks, costs the loss nothing as seen from
    there, and hangs before the tissue as soon as the camera turns. Called after every step with the camera of its
    frame: the nearest one decides. What is nearer than the median counts as far as it: a camera that passes close to
    tissue must not tear it.

    Args:
        log_scales: (N, 3) log of mm. means: (N, 3) centers in world axes, mm. share: above 0.
        thickness: largest third scale relative to the smaller of the other two, as at the start; 1: any.
    """
    distance = (means - torch.as_tensor(camera.center).to(means)).norm(dim=1)
    reach = torch.maximum(distance, distance.median()).clamp(min=torch.finfo(means.dtype).tiny)
    largest = (share * reach).log()
    torch.minimum(log_scales, largest[:, None], out=log_scales)
    if thickness < 1:
        thin = log_scales[:, :2].amin(1) + math.log(thickness)
        torch.minimum(log_scales[:, 2], thin, out=log_scales[:, 2])
