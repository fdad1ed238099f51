"""Training of Gaussians: what changes in it, the start, the two stages, and the scene that results.

Two stages. Coarse: the first training frame alone, nothing deforms. Fine: a random training frame each time, deformed.
`N` Gaussians, `K` touched cells of planes, `P` tracks, `F` training frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cached_property, partial
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import render
from ..core.checks import input_error
from ..core.config import Config
from ..core.shell import command
from ..data import FrameSequence
from ..initialization.first_gaussians import create_gaussians
from ..model.basis import GIVEN, TRAINED
from ..model.gaussians import Gaussians
from ..model.hexplane import plane_shapes
from ..model.method import method_of
from ..model.motion import Field, Motion
from ..model.photometric import of_all_frames
from ..model.scene import SingleScene
from ..system.arrays_file import ArraySpec, part
from .density import scene_extent
from .density_stats import DensityStats
from .divergence import Diverged, DivergenceCheck
from .frames import TrainingFrames
from .gaussian_hooks import GaussianHooks
from .missed_tools import VISITS, MissedToolFinder
from .ops import TrainingOps, ops_for
from .optimizer import Optimizer
from .photometric import ClearedFrames, smoke_of
from .state import GaussiansState
from .step import TrainingStep
from .tracks import StartTracks
from .trainer import DEFAULT_FRAMES_PER_SECOND, Stage, StepReport, Trainer, cameras_of, device_for, stage_length

STILL_CAMERA_SCALE = 10.0  # spatial scale of a sequence with a static camera, mm


def spatial_scale(extent: float, fit_to_clip: bool) -> float:
    """What multiplies learning rates that are lengths, mm: the `scene_extent`, or 10 where the camera is still.

    `fit_to_clip` takes no more than 10: what a long camera path multiplies throws the tissue out of view.
    """
    if extent <= 1e-3:
        return STILL_CAMERA_SCALE
    return min(extent, STILL_CAMERA_SCALE) if fit_to_clip else extent


def state_schema(motion: Motion, cfg: Config, *, finds_missed_tools: bool) -> dict[str, ArraySpec]:
    """The arrays of a `GaussiansState`; where missed tools are looked for, also how much of each frame was left out."""
    model = motion.schema(cfg)
    trained = {name.removeprefix("gaussians."): spec for name, spec in model.items() if name.startswith("gaussians.")}
    trained |= {name: ArraySpec("float32", shape) for name, shape in motion.parameter_shapes(cfg).items()}
    trained = {name: spec for name, spec in trained.items() if name not in GIVEN}
    optimizer = {f"{name}.{moment}": spec for name, spec in trained.items() for moment in ("first", "second")}
    for name, spec in trained.items():
        optimizer[f"{name}.steps"] = ArraySpec("int64", (spec.shape[1] if name in TRAINED else 1,))
    planes = motion.planes(cfg)
    if planes is not None:
        moments = ArraySpec("float32", ("K", planes.channels))
        cells = sum(rows * columns for scale in plane_shapes(planes) for rows, columns in scale.values())
        of_planes = {"marks": ArraySpec("uint8", (cells,)), "exp_avg": moments, "exp_avg_sq": moments}
        of_planes["steps"] = ArraySpec("int64", (1,))
        optimizer |= {f"plane_adam.{name}": spec for name, spec in of_planes.items()}
    found = {f"optimizer.{name}": spec for name, spec in optimizer.items()}
    found |= {f"stats.{field.name}": ArraySpec("float32", ("N",)) for field in fields(DensityStats)}
    found |= {"left_out": ArraySpec("float32", ("F", VISITS))} if finds_missed_tools else {}
    if cfg.loss.track_weight and cfg.init.motion == "flow":
        found["tracks.displacement"] = ArraySpec("float32", ("F", "P", 3))
        found |= {"tracks.followed": ArraySpec("float32", ("F", "P")), "tracks.rows": ArraySpec("int64", ("N",))}
    return model | found


class GaussianTrainer(Trainer):
    """See `Trainer`."""

    state: GaussiansState

    def __init__(self, sequence: FrameSequence, cfg: Config, ops: TrainingOps | None = None) -> None:
        """Prepare with `ops`, or with those that suit the device; nothing is computed yet.

        Raises:
            InputError: the cameras cannot be used, the backend has no device here, or there is no right eye.
        """
        if cfg.data.eyes == "both" and sequence.right_eye is None:
            fix = f"`{command('prepare', 'VIDEO', sequence.path)} --keep-right`, or leave --eyes out."
            raise input_error(sequence.path, "right/ and baseline_mm for --eyes both", "no right eye", fix)
        self.method = cast(GaussianHooks, method_of(cfg))
        self.sequence, self.cfg = sequence, self.method.fitted(cfg, len(sequence))
        self.motion = self.method.motion(self.cfg)
        self.device = device_for(cfg.render.backend)
        self.ops = ops or ops_for(self.device)
        self.cameras = cameras_of(sequence)
        frames = TrainingFrames(sequence, "zero" if cfg.released.prior else "reflect", self.device)
        centers = torch.from_numpy(np.stack([self.cameras[i].center for i in frames.indices]))
        extent = scene_extent(centers)
        self.spatial_scale = spatial_scale(extent, cfg.fit_to_clip)
        self.step_once = TrainingStep(
            method=self.method,
            motion=self.motion,
            cfg=self.cfg,
            frames=frames,
            extent=extent,
            rasterize=render.load(cfg.render.backend),
            ops=self.ops,
            check=DivergenceCheck(self.device, blocking=self.device.type == "cpu"),
            missed_tools=MissedToolFinder(sequence) if sequence.masks_are_found and not cfg.loss.trust_masks else None,
            background=torch.tensor(self.method.background, device=self.device),
        )

    @cached_property
    def smoke(self) -> NDArray[np.float32] | None:
        """(F, I, J, 2) of the training frames: see `photometric`; a function of these frames alone."""
        return smoke_of(self.sequence.frames("train"), self.cfg.render.photometric)

    def notes(self) -> list[str]:
        """See `Trainer.notes`."""
        if self.smoke is None:
            return []
        share = (self.smoke[..., 1].max((1, 2)) > 0).mean()
        return [
            f"smoke in {share:.0%} of the training frames; it is modeled apart from the tissue "
            "(--render.photometric none takes it for tissue)"
        ]

    def start(self) -> None:
        """See `Trainer.start`."""
        cfg, frames = self.cfg, self.sequence.frames("train")
        if self.smoke is not None:
            frames = ClearedFrames(frames, self.smoke)
        first = self.method.first_gaussians(frames, cfg)
        cloud, motion, tracks = first.cloud, first.motion, None
        gaussians = create_gaussians(cloud.points, cloud.colors, first.log_scales, cfg, first.quats, first.opacities)
        if motion is not None:
            trained = self.step_once.frames.indices
            gaussians["motion"].detach()[:] = torch.from_numpy(motion.coefficients)
            gaussians["frame_motion"].detach()[:, trained] = torch.from_numpy(motion.at_frames)
            if cfg.loss.track_weight:
                tracks = StartTracks.along(motion, [frame.time for frame in frames]).to(self.device)
        field = self.motion.field(gaussians["means"].detach(), cfg)
        stage = Stage.COARSE if cfg.schedule.coarse_iterations else Stage.FINE
        shares = torch.zeros(len(self.sequence.indices("train")), VISITS) if self.step_once.missed_tools else None
        self._enter(stage, gaussians.to(self.device), field and field.to(self.device), tracks, shares)

    def restore(self, stage: Stage, iteration: int, arrays: Mapping[str, Tensor]) -> None:
        """See `Trainer.restore`."""
        gaussians = Gaussians(part(arrays, "gaussians.")).to(self.device)
        field = self.motion.field_of(part(arrays, "field."), self.cfg)
        held = part(arrays, "tracks.")
        tracks = StartTracks(**held).to(self.device) if held else None
        self._enter(stage, gaussians, field and field.to(self.device), tracks, arrays.get("left_out"))
        self.state.iteration = iteration
        self.state.optimizer.load_state_arrays(part(arrays, "optimizer."))
        stats = {name: value.to(self.device) for name, value in part(arrays, "stats.").items()}
        self.state.stats = DensityStats(**stats)

    def _enter(
        self, stage: Stage, gaussians: Gaussians, field: Field | None, tracks: StartTracks | None, shares: Tensor | None
    ) -> None:
        rate_of = partial(self.method.rate, cfg=self.cfg, spatial_scale=self.spatial_scale)
        optimizer = Optimizer(gaussians, field, self.cfg, rate_of, self.ops)
        stats = DensityStats.zeros(len(gaussians), self.device)
        self.step_once.smoke = None if self.smoke is None else torch.from_numpy(self.smoke).to(self.device)
        self.state = GaussiansState(stage, 0, gaussians, field, optimizer, stats, tracks, shares)

    def schema(self) -> dict[str, ArraySpec]:
        """See `Trainer.schema`."""
        return state_schema(self.motion, self.cfg, finds_missed_tools=self.step_once.missed_tools is not None)

    def step(self) -> StepReport:
        """See `Trainer.step`, and `TrainingStep` for what happens in it."""
        state = self.state
        if state.stage is Stage.COARSE and state.iteration >= stage_length(self.cfg, Stage.COARSE):
            self._enter(Stage.FINE, state.gaussians, state.field, state.tracks, state.left_out)
            if self.method.keeps_optimizer:
                self.state.optimizer = state.optimizer
        return self.step_once(self.state)

    def synchronize(self) -> None:
        """See `Trainer.synchronize`."""
        try:
            self.step_once.check.read(applied=self.state.iteration)
        except Diverged as error:
            self.state.iteration = error.last_good
            raise

    def scene(self) -> SingleScene:
        """See `Trainer.scene`."""
        state, trained, num = self.state, self.step_once.frames.indices, len(self.sequence)
        holds, eye = self.motion.stays_at_the_ends, self.sequence.right_eye
        return SingleScene(
            gaussians=state.gaussians.to("cpu"),
            field=state.field and state.field.to("cpu"),
            config=self.cfg,
            cameras=self.cameras,
            frames_per_second=self.sequence.frames_per_second or DEFAULT_FRAMES_PER_SECOND,
            prior_score=state.stats.score(self.cfg.released.unobserved_score).cpu(),
            num_valid=state.stats.num_valid.cpu().clone(),
            lengths_are_relative=self.sequence.depth_is_relative,
            trained_from=trained[0] / num if holds else 0.0,
            trained_until=trained[-1] / num if holds else 1.0,
            baseline_mm=eye.baseline_mm if eye and self.cfg.data.eyes == "both" else 0.0,
            smoke=None if self.smoke is None else of_all_frames(torch.from_numpy(self.smoke), trained, num),
        )
