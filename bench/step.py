"""One iteration, to compare two checkouts of the project in turn, and what it would launch on a device.

    PYTHONPATH=CHECKOUT/src python bench/step.py [--preset default] [--launches]

prints the median of 80 iterations at full size with the temporal term, on a phantom of 12 frames of 640x512, after 30
uncounted ones; with `--launches` how many PyTorch operations one of them takes on a device, without the rasterizer.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import common
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from endoprior.core.types import RenderOutput
from endoprior.data import load_sequence
from endoprior.model.presets import preset
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.ops import NUMBA, TORCH, TrainingOps

UNCOUNTED, COUNTED, NEVER = 30, 80, 10**6
NO_WORK = (
    "view", "detach", "t", "transpose", "expand", "slice", "select", "unsqueeze", "squeeze", "unbind", "split",
    "_unsafe_view", "alias", "permute", "as_strided", "empty_like", "split_with_sizes", "empty", "new_empty",
    "diagonal", "_reshape_alias", "lift_fresh", "is_same_size", "resolve_conj",
)  # fmt: skip
"""Operations that only look at a tensor in another way, or make room."""


class Launches(TorchDispatchMode):
    """Counts operations that do some work."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        """See `TorchDispatchMode`."""
        self.count += function.name().removeprefix("aten::").split(".")[0] not in NO_WORK
        return function(*args, **(kwargs or {}))


def trainer_of(name: str, folder: Path, ops: TrainingOps = NUMBA, **changes: int) -> GaussianTrainer:
    cfg = preset(name)
    cfg = replace(
        cfg,
        init=replace(cfg.init, **changes),
        schedule=replace(cfg.schedule, coarse_iterations=0, half_resolution_iterations=0),
        temporal=replace(cfg.temporal, start_iteration=1, min_valid=0),
        density=replace(cfg.density, start_iteration=NEVER),
    )
    trainer = GaussianTrainer(load_sequence(folder), cfg, ops)
    trainer.start()
    return trainer


def median_ms(trainer: GaussianTrainer) -> float:
    taken = []
    for _ in range(UNCOUNTED + COUNTED):
        began = time.perf_counter()
        trainer.step()
        taken.append(1e3 * (time.perf_counter() - began))
    return statistics.median(taken[UNCOUNTED:])


def launches(name: str, folder: Path) -> int:
    def picture(splats, camera, *, background, depth_grad_to_means=True) -> RenderOutput:
        means2d = splats.means[:, :2] * 1.0
        tied = means2d.sum() + sum(getattr(splats, n).sum() for n in ("quats", "scales", "opacities", "sh"))
        flat = tied.expand(camera.height, camera.width)
        radii = torch.ones(len(splats), dtype=torch.int32)
        return RenderOutput(background.expand(*flat.shape, 3) + tied, flat.clone(), flat.clone(), means2d, radii)

    trainer = trainer_of(name, folder, TORCH, budget=2000)
    trainer.step_once.rasterize = picture
    while True:
        with Launches() as counted:
            report = trainer.step()
        if "distance" in report.losses and report.iteration > 3:
            return counted.count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--launches", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "phantom"
        write_phantom(folder, PhantomConfig(frames=12, width=640, height=512))
        if options.launches:
            print(f"{options.preset}: {launches(options.preset, folder)} operations")
        else:
            print(f"{common.source_commit()} {options.preset}: {median_ms(trainer_of(options.preset, folder)):.1f} ms")


if __name__ == "__main__":
    main()
