"""One training run, step by step.

Two stages. Coarse: the first training frame alone, nothing deforms. Fine: a random training frame each time, deformed.
Every random choice is a pure function of (seed, stage, iteration), so a resumed run repeats an uninterrupted one.
"""

from __future__ import annotations

import time as clock

import numpy as np
import torch
from torch import Tensor

from . import density, render, temporal
from .checks import InputError
from .compiled import compiled
from .config import Config
from .data import Sequence
from .density import DensityStats
from .divergence import ADVICE, Diverged
from .geometry import project
from .inspector import Inspector
from .loss_kernels import supervised_losses
from .model.basis import motion_layout
from .model.deformation import HexPlaneField, Offsets
from .model.gaussians import Gaussians, create_gaussians
from .model.initialize import initial_log_scales, initial_points
from .model.scene import Scene, check_cameras, offsets_at
from .model.tracks import initial_motion
from .morton import morton_order
from .optim import Optimizer
from .train_state import Losses, Stage, StepReport, TrainState
from .training_frames import TrainingFrame, TrainingFrames
from .types import RenderOutput

DEFAULT_FRAMES_PER_SECOND = 25.0
"""Playing speed of a sequence that does not say its own."""


class Trainer:
    """One training run; `steps` advances it, `scene` is its result so far."""

    def __init__(self, sequence: Sequence, cfg: Config) -> None:
        self.sequence, self.cfg = sequence, cfg.fitted(len(sequence))
        self.device = torch.device("cuda" if cfg.render.backend == "cuda" else "cpu")
        self.frames = TrainingFrames(sequence, cfg.prior, self.device)
        self.rasterize = render.load(cfg.render.backend)
        self.background = torch.zeros(3, device=self.device)
        self.cameras = tuple(sequence.camera(i) for i in range(len(sequence)))
        try:
            check_cameras(self.cameras)
        except InputError as error:
            raise InputError(f"{sequence.path}: {error} Check the calibration and the unit of the poses.") from None
        self.spatial_scale = spatial_scale(self.camera_centers, cfg)
        self.state: TrainState | None = None
        self._inspector = Inspector(self.device, waits=compiled(self.background))

    @property
    def camera_centers(self) -> Tensor:
        """(T, 3) camera positions of the training frames, mm."""
        return torch.from_numpy(np.stack([self.cameras[i].center for i in self.frames.indices]))

    def start(self) -> None:
        """Draw the initial points and build the state before the first iteration."""
        cfg = self.cfg
        cloud = initial_points(self.sequence.frames("train"), cfg.init, cfg.prior, cfg.seed)
        cloud = cloud.taken(morton_order(cloud.points))
        log_scales = initial_log_scales(cloud.points, cfg.init.variance_factor)
        gaussians = create_gaussians(cloud.points, cloud.colors, log_scales, cfg)
        if cfg.init.motion == "flow" and cfg.deformation.kind == "basis":
            motion = initial_motion(self.sequence.frames("train"), cloud, cfg.deformation.basis)
            gaussians["motion"].detach()[..., motion_layout(cfg.deformation)["means"]] = torch.from_numpy(motion)
        field = None
        if cfg.deformation.kind == "hexplane":
            generator = torch.Generator().manual_seed(cfg.seed)
            field = HexPlaneField.from_points(gaussians["means"].detach(), cfg.deformation, generator)
        first = Stage.COARSE if cfg.schedule.coarse_iterations else Stage.FINE
        self._enter(first, gaussians.to(self.device), field and field.to(self.device))

    def _enter(self, stage: Stage, gaussians: Gaussians, field: HexPlaneField | None) -> None:
        optimizer = Optimizer(gaussians, field, self.cfg, self.spatial_scale)
        self.state = TrainState(stage, 0, gaussians, field, optimizer, DensityStats.zeros(len(gaussians), self.device))

    def stage_length(self, stage: Stage) -> int:
        """Iterations of a stage."""
        schedule = self.cfg.schedule
        return schedule.coarse_iterations if stage is Stage.COARSE else schedule.fine_iterations

    @property
    def finished(self) -> bool:
        """Whether all iterations are done."""
        state = self.state
        return state.stage is Stage.FINE and state.iteration >= self.stage_length(Stage.FINE)

    def step(self) -> StepReport:
        """One iteration: draw, compare, differentiate, grow or prune, update.

        On a device it only queues the work: the host waits where it must, every 20 iterations or so.

        Raises:
            Diverged: the loss or a gradient is not finite, the pictures show nothing, or no Gaussian is left. Nothing
                infinite has reached the state, and `state.iteration` is the last one that counts.
        """
        began = clock.perf_counter()
        state = self.state
        if state.stage is Stage.COARSE and state.iteration >= self.stage_length(Stage.COARSE):
            self._enter(Stage.FINE, state.gaussians, state.field)
            state = self.state
        cfg, iteration = self.cfg, state.iteration + 1
        fine = state.stage is Stage.FINE
        rng = np.random.default_rng([cfg.seed, int(state.stage), iteration])
        position = int(rng.integers(len(self.frames))) if fine else 0
        half = fine and iteration <= cfg.schedule.half_resolution_iterations
        frame = self.frames.frame(position, half=half)

        before_frame = None
        if fine and cfg.temporal.weight > 0 and iteration >= cfg.temporal.start_iteration:
            before_frame = self.frames.before(position)
        offsets, means_before = self._deform(frame, before_frame) if fine else (None, None)
        splats = state.gaussians.splats(offsets, self._sh_degree(iteration))
        out = self.rasterize(
            splats,
            frame.camera,
            background=self.background,
            depth_grad_to_means=cfg.render.depth_grad_to_means,
        )
        out.means2d.retain_grad()
        terms = supervised_terms(out, frame, cfg)
        if before_frame is not None:
            terms |= self._temporal_terms(splats.means, means_before, out, frame, before_frame)
        sum(terms.values()).backward()
        losses, ending = Losses(terms), iteration == self.stage_length(state.stage)
        crowd_changes = density.due(iteration, fine and ending, cfg.density)
        try:
            self._inspector.see(losses, state.optimizer, frame.brightness, look=ending or crowd_changes)
        except Diverged as error:
            state.optimizer.drop_gradients()
            state.iteration -= error.ago
            raise

        with torch.no_grad():
            self._observe(out, position, frame, iteration)
            state.optimizer.step(iteration, self._inspector.frozen)
            if crowd_changes:
                self._control_density(rng)
        state.iteration = iteration
        seconds = self._inspector.seconds(began)
        return StepReport(state.stage, iteration, losses, len(state.gaussians), seconds)

    def settle(self) -> None:
        """Wait for a device and judge what it did, so that the state is known to be good; on the CPU it always is.

        Raises:
            Diverged: as `step`.
        """
        try:
            self._inspector.look()
        except Diverged as error:
            self.state.iteration -= error.ago + 1
            raise

    def _sh_degree(self, iteration: int) -> int:
        """Degree in use: +1 per `sh_every` iterations of each stage, never falling back (method of 3DGS)."""
        schedule = self.cfg.schedule
        done = iteration // schedule.sh_every
        if self.state.stage is Stage.FINE:
            done += schedule.coarse_iterations // schedule.sh_every
        return min(done, schedule.sh_degree)

    def _deform(self, frame: TrainingFrame, before_frame: TrainingFrame | None) -> tuple[Offsets, Tensor | None]:
        """Offsets at `frame` and, where one call gives both with gradients, the centers (N, 3) at the frame before."""
        state = self.state
        if before_frame is None or state.field is None or self.cfg.temporal.gradient != "both":
            return offsets_at(state.gaussians, state.field, frame.time, self.cfg), None
        means = state.gaussians["means"]
        offsets, displacement = state.field.offsets_and_displacement(means, frame.time, before_frame.time)
        return offsets, means + displacement

    def _temporal_terms(
        self,
        means: Tensor,
        means_before: Tensor | None,
        out: RenderOutput,
        frame: TrainingFrame,
        before_frame: TrainingFrame,
    ) -> dict[str, Tensor]:
        """L_local of Eq. (11), weighted; nothing with few Gaussians."""
        cfg, state = self.cfg.temporal, self.state
        stats = state.stats
        drawn = out.radii > 0
        if cfg.valid_at_both:
            drawn = density.valid_projection(out.means2d, out.radii, frame.tissue_mask)
        eligible = drawn & (stats.num_valid >= cfg.min_valid)
        score = stats.score(self.cfg.density.unobserved_score)
        index, weights = temporal.choose_on(score, eligible, cfg)
        if len(index) < temporal.least_points(cfg):
            return {}
        before = self._means_before(before_frame.time, index) if means_before is None else means_before[index]
        if cfg.valid_at_both:
            kept = on_tissue(before.detach(), before_frame)
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

    def _means_before(self, time: float, index: Tensor) -> Tensor:
        """(P, 3) centers of the chosen Gaussians at an earlier moment, with a gradient only if that end is trained."""
        state = self.state
        if self.cfg.temporal.gradient == "both":
            # Moving all and then choosing is cheaper than the scattered gradient of choosing first.
            moved = state.gaussians["means"] + offsets_at(state.gaussians, state.field, time, self.cfg).means
            return moved[index]
        with torch.no_grad():
            offsets = offsets_at(state.gaussians, state.field, time, self.cfg, index)
            return state.gaussians["means"][index] + offsets.means

    def _observe(self, out: RenderOutput, position: int, frame: TrainingFrame, iteration: int) -> None:
        """Feed the running statistics: the gradient always, the prior's score when the config says so."""
        cfg, state = self.cfg.density, self.state
        camera = frame.camera
        frozen = self._inspector.frozen
        state.stats.add_gradient(out, camera.width, camera.height, frozen)
        if cfg.score_mode == "every" or density.due(iteration, False, cfg):
            prior, tissue_mask = self.frames.prior(position)
            scale = prior.shape[1] / camera.width
            state.stats.add_score(out, prior, tissue_mask, state.gaussians.opacities, scale, frozen)

    def _control_density(self, rng: np.random.Generator) -> None:
        state, cfg = self.state, self.cfg.density
        extent = density.scene_extent(self.camera_centers, state.gaussians["means"], cfg)
        planned = density.plan(state.stats, state.gaussians.scales, state.gaussians.opacities, extent, cfg)
        if bool(planned.remove.all()):
            raise Diverged(f"expected Gaussians that explain the frames; all {len(planned.remove):,} faded. {ADVICE}")
        state.stats = state.optimizer.apply_plan(planned, state.stats, rng)

    def scene(self) -> Scene:
        """The scene as it stands."""
        state = self.state
        return Scene(
            gaussians=state.gaussians.to("cpu"),
            field=state.field and state.field.to("cpu"),
            config=self.cfg,
            cameras=self.cameras,
            frames_per_second=self.sequence.frames_per_second or DEFAULT_FRAMES_PER_SECOND,
            prior_score=state.stats.score(self.cfg.density.unobserved_score).cpu(),
            num_valid=state.stats.num_valid.cpu().clone(),
            lengths_are_relative=self.sequence.depth_is_relative,
        )


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
        view = torch.from_numpy(camera.world_to_camera.astype(np.float32)).to(points.device, non_blocking=True)
        x, y, z = (points @ view[:3, :3].T + view[:3, 3]).unbind(-1)
        means2d = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
        return density.valid_projection(means2d, (z > 0).int(), frame.tissue_mask)
    pixels, z = project(points.numpy(), frame.camera)
    means2d, in_front = torch.from_numpy(pixels.astype(np.float32)), torch.from_numpy(z > 0).int()
    return density.valid_projection(means2d, in_front, frame.tissue_mask)


def spatial_scale(camera_centers: Tensor, cfg: Config) -> float:
    """Factor of the learning rates that are lengths: 1.1 x radius of the camera path; a constant for a still one."""
    radius = 1.1 * float((camera_centers - camera_centers.mean(0)).norm(dim=-1).max())
    return radius if radius > 1e-3 else cfg.optim.still_camera_scale
