"""A whole training iteration of the presets `default` and `paper`, beside the same loop with plain torch inside.

The data is a phantom of a few frames. One and the same iteration is repeated: a fine one at full resolution, with all
degrees of color, with the temporal term, without growth.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import common
import plain
import torch

from endoprior.core.config import Config
from endoprior.data import FrameSequence, load_sequence
from endoprior.model import basis
from endoprior.model.hexplane_field import HexPlaneField
from endoprior.model.presets import preset
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.render import numba as numba_backend
from endoprior.training import gaussian_hooks, local_motion, temporal
from endoprior.training import step as iteration_module
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.ops import NUMBA, TORCH, TrainingOps
from endoprior.training.optimizer import Optimizer
from endoprior.training.trainer import Stage, StepReport

PRESETS = ("default", "paper")
FRAMES = 4
"""Of which the second is a test frame: the fourth has a training frame just before it."""
FIRST, LAST = 4, 40
"""Iterations among which the one to repeat is looked for; all degrees of color are in use from the first on."""
NEVER = 1_000_000
TORCH_MOST = common.Size(20_000, 640, 512)
"""With more Gaussians or pixels, autograd's memory takes torch from seconds to minutes."""
PARTS = {
    "deformation": [(basis, "basis_offsets"), (HexPlaneField, "offsets"), (HexPlaneField, "offsets_and_displacement")],
    "projection + SH": [(numba_backend, "project_forward")],
    "binning + sort": [(numba_backend.tiles, "build")],
    "compositing": [(numba_backend, "composite_forward")],
    "losses": [(gaussian_hooks, "supervised_terms")],
    "temporal term": [
        (temporal, "choose"),
        *((local_motion, f"{n}_numba") for n in ("neighbors", "affinity", "local_motion")),
    ],
    "compositing backward": [(numba_backend, "composite_backward"), (numba_backend, "gather")],
    "projection backward": [(numba_backend, "project_backward")],
    "other backward": [(torch.Tensor, "backward")],
    "density statistics": [(iteration_module.TrainingStep, "_observe")],
    "optimizer": [(Optimizer, "step")],
}


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """For each preset and size one row for the whole, then one for each part."""
    measured = []
    for width, height in common.pictures(sizes):
        with tempfile.TemporaryDirectory() as folder:
            write_phantom(Path(folder) / "phantom", PhantomConfig(frames=FRAMES, width=width, height=height))
            sequence = load_sequence(Path(folder) / "phantom")
            for name in PRESETS:
                for num in (size.num for size in sizes if size[1:] == (width, height)):
                    measured += rows(name, sequence, common.Size(num, width, height))
    return measured


def rows(name: str, sequence: FrameSequence, size: common.Size) -> list[common.Row]:
    trainer = started(sequence, config(name, size.num))
    repeated = settle(trainer)
    ours = {"": lambda _: repeat(trainer, repeated)}
    theirs = None
    if size.num <= TORCH_MOST.num and size.width <= TORCH_MOST.width:
        other = started(sequence, trainer.cfg, TORCH)
        theirs = {"": lambda _: repeat(other, repeated)}
    picture, num = (size.width, size.height), len(trainer.state.gaussians)
    measured = common.rows(f"iteration {name}", common.race(ours, theirs), num, picture)
    return measured + common.part_rows(f"iteration {name}", ours, PARTS, common.Size(num, *picture))


def config(name: str, num: int) -> Config:
    changes = {"init.budget": num, "temporal.start_iteration": 1, "temporal.min_valid": 1}
    changes |= {f"schedule.{stage}_iterations": 0 for stage in ("coarse", "half_resolution")} | {"schedule.sh_every": 1}
    return preset(name).fitted(68).replace(changes | {"density.start_iteration": NEVER})


def started(sequence: FrameSequence, cfg: Config, ops: TrainingOps = NUMBA) -> GaussianTrainer:
    """A trainer before its first iteration, with its cache of frames filled; with `TORCH`, plain torch throughout."""
    trainer = GaussianTrainer(sequence, cfg, ops)
    if ops is TORCH:
        trainer.step_once.rasterize = plain.rasterize
    trainer.start()
    frames = trainer.step_once.frames
    for position in range(len(frames)):
        frames.frame(position)
        frames.prior(position)
    return trainer


def settle(trainer: GaussianTrainer) -> int:
    """Train until all is warm and an iteration had the temporal term; return that iteration."""
    for iteration in range(1, LAST):
        if "distance" in trainer.step().terms and iteration >= FIRST:
            return iteration
    raise RuntimeError(f"no iteration up to {LAST} had the temporal term: too few Gaussians or frames")


def repeat(trainer: GaussianTrainer, iteration: int) -> StepReport:
    trainer.state.stage, trainer.state.iteration = Stage.FINE, iteration - 1
    return trainer.step()
