"""Training of a radiance field: one stage, rays of one frame in each iteration; what it changes, and how it resumes."""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from endoprior import Config, FrameSequence
from endoprior.system.arrays_file import ArraySpec, part
from endoprior.training.divergence import MAX_GRADIENT, Diverged, Watch, unusable_numbers
from endoprior.training.trainer import (
    DEFAULT_FRAMES_PER_SECOND,
    Stage,
    StepReport,
    Trainer,
    cameras_of,
    device_for,
    stage_length,
)

from .field import RadianceField, RayBatch
from .presets import radiance_of
from .rays import RayFrames, rays_of
from .scene import RadianceScene

BETAS, EPSILON = (0.9, 0.999), 1e-8
"""Adam's: torch's own, which both releases use."""
ADVICE = (
    "Lower --radiance.learning-rate, raise --radiance.rays, or look for wrong depth and poses with `endoprior check`"
)

MOMENTS = {"first": "exp_avg", "second": "exp_avg_sq"}
"""Adam's moments: name in a checkpoint, name in torch."""
ROUNDS, OUTLIERS = 4, 0.1
"""Times that depth is refined, and the share of pixels that is corrected: those farthest from the rendered depth."""


@dataclass
class RadianceState:
    """All that changes while training."""

    stage: Stage
    """Always the fine one."""
    iteration: int
    """Iterations already done."""
    field: RadianceField
    optimizer: torch.optim.Adam
    depths: Tensor | None
    """(F, H, W) depth of each training frame, mm, 0 where missing, on the CPU; None where it is not refined."""

    def arrays(self) -> dict[str, Tensor]:
        """Every tensor by the name that it has in a checkpoint."""
        arrays = {f"field.{name}": value for name, value in self.field.state_dict().items()}
        for name, parameter in self.field.named_parameters():
            known = self.optimizer.state.get(parameter, {})
            for moment, stored in MOMENTS.items():
                arrays[f"optimizer.{name}.{moment}"] = known.get(stored, torch.zeros_like(parameter.detach()))
            steps = int(known["step"]) if known else 0
            arrays[f"optimizer.{name}.steps"] = torch.tensor([steps], dtype=torch.int64)
        return arrays if self.depths is None else arrays | {"depths": self.depths}

    def load(self, iteration: int, arrays: Mapping[str, Tensor]) -> None:
        """Take over what `arrays` gave, trusted to fit."""
        self.iteration = iteration
        self.field.load_state_dict(part(arrays, "field."))
        for name, parameter in self.field.named_parameters():
            held = part(arrays, f"optimizer.{name}.")
            if int(held["steps"]):
                moments = {stored: held[moment].to(parameter.device) for moment, stored in MOMENTS.items()}
                self.optimizer.state[parameter] = {"step": held["steps"][0].float(), **moments}
        self.depths = arrays.get("depths")


def state_schema(field: RadianceField, depths: tuple[int | str, ...] | None) -> dict[str, ArraySpec]:
    """The arrays of a state; `depths` is the shape of the refined depths, None without them."""
    schema = {f"field.{name}": spec for name, spec in type(field).schema(field.cfg).items()}
    for name, parameter in field.named_parameters():
        moment = ArraySpec("float32", tuple(parameter.shape))
        schema |= {f"optimizer.{name}.{each}": moment for each in MOMENTS}
        schema[f"optimizer.{name}.steps"] = ArraySpec("int64", (1,))
    return schema if depths is None else schema | {"depths": ArraySpec("float32", depths)}


class RadianceTrainer(Trainer):
    """See `Trainer`.

    Every random choice is a pure function of (seed, iteration), so a resumed run repeats an uninterrupted one.
    """

    state: RadianceState

    def __init__(self, sequence: FrameSequence, cfg: Config, kind: type[RadianceField]) -> None:
        """Prepare to train a `kind` of field; InputError if cameras cannot be used, or the backend has no device."""
        self.sequence, self.cfg, self.kind = sequence, cfg.fitted(len(sequence)), kind
        self.radiance = radiance_of(self.cfg)
        self.device = device_for(cfg.render.backend)
        self.cameras = cameras_of(sequence)
        self.frames = RayFrames(sequence, only_measured=kind.only_measured)
        self._watch = Watch(ADVICE)

    @override
    def start(self) -> None:
        """Measure the sequence and give the networks their first values."""
        self._enter()
        self.state.field.cpu().start(self.frames, torch.Generator().manual_seed(self.cfg.seed))
        self.state.field.to(self.device)
        if self.radiance.refine_every:
            depths = [self.frames.depth(k) for k in range(len(self.frames))]
            self.state.depths = torch.from_numpy(np.stack(depths))

    @override
    def restore(self, stage: Stage, iteration: int, arrays: Mapping[str, Tensor]) -> None:
        self._enter()
        self.state.load(iteration, arrays)

    def _enter(self) -> None:
        field = self.kind(self.radiance).to(self.device)
        adam = torch.optim.Adam(field.parameters(), self.radiance.learning_rate, BETAS, EPSILON, foreach=False)
        self.state = RadianceState(Stage.FINE, 0, field, adam, None)

    @override
    def schema(self) -> dict[str, ArraySpec]:
        camera = self.frames.camera
        refines = self.radiance.refine_every > 0
        with torch.device("meta"):
            field = self.kind(self.radiance)
        return state_schema(field, ("F", camera.height, camera.width) if refines else None)

    def step(self) -> StepReport:
        """One iteration: rays of one frame, their terms, their gradients, a check, then Adam.

        Raises:
            Diverged: the loss or a gradient is not finite, or rays have long been no better than black ones. The state
                is the one before.
        """
        began, state, cfg = clock.perf_counter(), self.state, self.cfg
        iteration, share = state.iteration + 1, (state.iteration + 1) / stage_length(self.cfg, Stage.FINE)
        rng = np.random.default_rng([cfg.seed, int(state.stage), iteration])
        field, buffers = state.field, {name: value.clone() for name, value in state.field.named_buffers()}
        batch = self.batch(rng)
        terms = field.losses(batch, share, rng)
        state.optimizer.zero_grad(set_to_none=True)
        reduce(torch.add, terms.values()).backward()
        values = {name: float(value.detach()) for name, value in terms.items()}
        reason = unusable_numbers(values, _unusable(field), ADVICE)
        if reason is None:
            black = field.color_term(torch.zeros_like(batch.color), batch.color)
            reason = self._watch.see(values["color"], float(black))
        if reason is not None:
            state.optimizer.zero_grad(set_to_none=True)
            for name, value in field.named_buffers():
                value.copy_(buffers[name])
            raise Diverged(reason)
        for group in state.optimizer.param_groups:
            group["lr"] = self.radiance.learning_rate * field.rate(share)
        state.optimizer.step()
        state.optimizer.zero_grad(set_to_none=True)
        state.iteration = iteration
        if due(iteration, self.radiance.refine_every):
            self._refine()
        losses = {name: value.detach() for name, value in terms.items()}
        return StepReport(state.stage, iteration, losses, 0, clock.perf_counter() - began)

    def batch(self, rng: np.random.Generator) -> RayBatch:
        """Rays of a random training frame, and what it shows there."""
        usable = self.frames.usable
        position = usable[int(rng.integers(len(usable)))]
        frame = self.frames.frame(position)
        pixels = self.frames.draw(position, self.radiance.rays, rng)
        known = self.frames.depth(position) if self.state.depths is None else self.state.depths[position].numpy()
        return RayBatch(
            rays_of(frame.camera, pixels, self.device),
            frame.time,
            torch.from_numpy(frame.rgb_u8.reshape(-1, 3)[pixels]).to(self.device).float() / 255,
            torch.from_numpy(known.ravel()[pixels]).to(self.device),
        )

    def _refine(self) -> None:
        """Correct the depth of every training frame by the rendered one."""
        scene, depths = self._scene(), self.state.depths
        assert depths is not None
        for position in range(len(self.frames)):
            frame = self.frames.frame(position)
            view, measured = scene.render(frame.time, frame.camera), depths[position]
            rendered = (view.depth / view.alpha.clamp(min=1e-6)).cpu()
            measured.copy_(refined(measured, rendered, torch.from_numpy(frame.tissue_mask)))

    def synchronize(self) -> None:
        """Nothing to wait for: each iteration is checked before its update, on every device."""

    @override
    def scene(self) -> RadianceScene:
        return self._scene().to("cpu")

    def _scene(self) -> RadianceScene:
        return RadianceScene(
            self.state.field,
            self.cfg,
            self.cameras,
            self.sequence.frames_per_second or DEFAULT_FRAMES_PER_SECOND,
            self.sequence.depth_is_relative,
        )


def due(iteration: int, every: int) -> bool:
    """Whether depth is refined after this iteration."""
    return every > 0 and iteration % every == 0 and iteration // every <= ROUNDS


def refined(measured: Tensor, rendered: Tensor, tissue: Tensor) -> Tensor:
    """(H, W) depth, mm, in which the worst tenth of all pixels has the rendered depth; what is no tissue is right."""
    error = torch.where(tissue, (rendered - measured).square(), torch.zeros_like(measured))
    limit = error.flatten().kthvalue(max(1, round((1 - OUTLIERS) * error.numel()))).values
    return torch.where(error > limit, rendered, measured)


def _unusable(field: RadianceField) -> dict[str, int]:
    """Entries of each gradient that are not finite or too large, by the name of the network."""
    counts: dict[str, int] = {}
    for name, parameter in field.named_parameters():
        if parameter.grad is not None:
            wrong = int((~(parameter.grad.abs() <= MAX_GRADIENT)).sum())  # NaN fails too
            network = name.partition(".")[0]
            counts[network] = counts.get(network, 0) + wrong
    return counts
