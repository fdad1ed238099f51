"""One training run, step by step.

Two stages. Coarse: the first training frame alone, nothing deforms. Fine: a random training frame each time, deformed.
Every random choice is a pure function of (seed, stage, iteration), so a resumed run repeats an uninterrupted one.
"""

from __future__ import annotations

import time as clock

import numpy as np
import torch
from torch import Tensor

from .. import render
from ..compute.compiled import compiled
from ..compute.morton import morton_order
from ..core.checks import InputError
from ..core.config import Config
from ..data import FrameSequence
from ..initialization.flow_tracks import initial_motion
from ..initialization.sampling import initial_log_scales, initial_points
from ..model.basis import motion_layout
from ..model.deformation import HexPlaneField
from ..model.gaussians import Gaussians, create_gaussians
from ..model.scene import Scene, check_cameras
from . import density
from .density import DensityStats
from .divergence import ADVICE, Diverged
from .frames import TrainingFrames
from .inspector import Inspector, Redo
from .optimizer import Optimizer
from .recorded import Recorder
from .state import Stage, StepReport, TrainState
from .step import Task, Work

DEFAULT_FRAMES_PER_SECOND = 25.0
"""Playing speed of a sequence that does not say its own."""


class Trainer:
    """One training run; `steps` advances it, `scene` is its result so far."""

    def __init__(self, sequence: FrameSequence, cfg: Config) -> None:
        self.sequence, self.cfg = sequence, cfg.fitted(len(sequence))
        self.device = device_for(cfg.render.backend)
        self.frames = TrainingFrames(sequence, cfg.prior, self.device)
        background = torch.zeros(3, device=self.device)
        self._inspector = Inspector(self.device, waits=compiled(background))
        work = Work(self.cfg, render.load(cfg.render.backend), background, self._inspector)
        self._work = work if compiled(background) else Recorder(work, self.device, None)
        self.cameras = tuple(sequence.camera(i) for i in range(len(sequence)))
        try:
            check_cameras(self.cameras)
        except InputError as error:
            raise InputError(f"{sequence.path}: {error} Check the calibration and the unit of the poses.") from None
        self.spatial_scale = spatial_scale(self.camera_centers, cfg)
        self.state: TrainState | None = None

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

        On a device it only queues the work: the host waits where it must, every 20 iterations or so. It may then have
        to do some of them again, and report those.

        Raises:
            Diverged: the loss or a gradient is not finite, the pictures show nothing, or no Gaussian is left. Nothing
                infinite has reached the state, and `state.iteration` is the last one that counts.
        """
        began = clock.perf_counter()
        if self.state.stage is Stage.COARSE and self.state.iteration >= self.stage_length(Stage.COARSE):
            self._enter(Stage.FINE, self.state.gaussians, self.state.field)
        state, cfg, iteration = self.state, self.cfg, self.state.iteration + 1
        fine, ending = state.stage is Stage.FINE, iteration == self.stage_length(state.stage)
        rng = np.random.default_rng([cfg.seed, int(state.stage), iteration])
        crowd_changes = density.due(iteration, fine and ending, cfg.density)
        task = self._task(iteration, int(rng.integers(len(self.frames))) if fine else 0)
        try:
            evidence = self._work(state, task)
            self._inspector.note(evidence, task.frame.brightness, look=ending or crowd_changes)
        except Diverged as error:
            state.optimizer.drop_gradients()
            state.iteration -= error.ago
            raise
        except Redo as news:
            state.iteration -= news.ago
            self._prepare_again()
            return self.step()
        if crowd_changes:
            with torch.no_grad():
                self._control_density(rng)
        state.iteration = iteration
        seconds = self._inspector.seconds(began)
        return StepReport(state.stage, iteration, evidence.losses, len(state.gaussians), seconds)

    def _task(self, iteration: int, position: int) -> Task:
        """What an iteration looks at: training frame number `position`."""
        cfg, fine = self.cfg, self.state.stage is Stage.FINE
        compared = fine and cfg.temporal.weight > 0 and iteration >= cfg.temporal.start_iteration
        sampled = cfg.density.score_mode == "every" or density.due(iteration, False, cfg.density)
        prior, prior_mask = self.frames.prior(position) if sampled else (None, None)
        return Task(
            iteration=iteration,
            frame=self.frames.frame(position, half=fine and iteration <= cfg.schedule.half_resolution_iterations),
            before=self.frames.before(position) if compared else None,
            prior=prior,
            prior_mask=prior_mask,
            fine=fine,
            sh_degree=self._sh_degree(iteration),
        )

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
        except Redo as news:
            self.state.iteration -= news.ago + 1
            self._prepare_again()

    def _prepare_again(self) -> None:
        """Before iterations are done again."""
        self._work.forget()  # a recording keeps the room that it was made with

    def _sh_degree(self, iteration: int) -> int:
        """Degree in use: +1 per `sh_every` iterations of each stage, never falling back (method of 3DGS)."""
        schedule = self.cfg.schedule
        done = iteration // schedule.sh_every
        if self.state.stage is Stage.FINE:
            done += schedule.coarse_iterations // schedule.sh_every
        return min(done, schedule.sh_degree)

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


def device_for(backend: render.Backend) -> torch.device:
    """Where to train for a backend to draw there.

    Raises:
        InputError: on a GPU, and torch sees none.
    """
    if backend not in render.ON_GPU:
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise InputError(
            f"render.backend {backend}: expected a GPU that torch can use; found none. Leave it out for the CPU; "
            "`endoprior doctor` tells what is missing."
        )
    return torch.device("cuda")


def spatial_scale(camera_centers: Tensor, cfg: Config) -> float:
    """Factor of the learning rates that are lengths: 1.1 x radius of the camera path; a constant for a still one."""
    radius = 1.1 * float((camera_centers - camera_centers.mean(0)).norm(dim=-1).max())
    return radius if radius > 1e-3 else cfg.optim.still_camera_scale
