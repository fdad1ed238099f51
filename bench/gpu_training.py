"""Training a whole scene on a GPU and on the CPU: seconds, scores, and whether a repetition is bit-identical."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch

from endoprior import render
from endoprior.core.config import Config
from endoprior.data import load_sequence
from endoprior.evaluation.scoring import evaluate
from endoprior.model.presets import preset
from endoprior.model.scene import Scene
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.system.devices import wait_for
from endoprior.training.gaussian_trainer import GaussianTrainer

FRAMES, WIDTH, HEIGHT = 63, 640, 512
SCORES = (
    "psnr_tissue", "psnr", "ssim", "depth_rmse_mm", "flow_error_dis_adjacent", "num_gaussians", "fps", "fps_cached",
)  # fmt: skip


@dataclass(frozen=True)
class Run:
    name: str
    frames: int = 0
    start_s: float = 0.0
    """Before the first iteration: frames, prior, initial points and their tracks, all on the CPU."""
    loop_s: float = 0.0
    """All iterations."""
    iterations: int = 0
    bits: str = ""
    """Digest of the trained Gaussians: the same for bit-identical ones."""
    memory_mb: float | None = None
    """Peak memory of the device."""
    scores: dict[str, float] = field(default_factory=dict)
    note: str = ""
    """The error, if there was one."""


def runs_of(backends: list[render.Backend], folder: Path, iterations: int | None) -> Iterator[Run]:
    for backend in backends:
        yield attempt(backend, folder, backend, iterations)
        if backend == "triton":
            yield attempt("triton again", folder, backend, iterations, scored=False)


def attempt(name: str, folder: Path, backend: render.Backend, iterations: int | None, *, scored: bool = True) -> Run:
    """A training; an error becomes its note, so that the others still run."""
    try:
        return trained(name, folder, backend, iterations, scored=scored)
    except Exception as error:
        return Run(name, note=f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")


@contextmanager
def sequence_at(data: Path | None, frames: int, width: int, height: int) -> Iterator[Path]:
    """The folder to train on; without one a phantom of that size, as long as it is needed."""
    if data is not None:
        yield data
        return
    with tempfile.TemporaryDirectory() as folder:
        write_phantom(Path(folder) / "phantom", PhantomConfig(frames=frames, width=width, height=height))
        yield Path(folder) / "phantom"


def config(backend: render.Backend, iterations: int | None) -> Config:
    cfg = preset("default").replace({"render.backend": backend})
    if iterations is None:
        return cfg
    lengths = {"schedule.fine_iterations": iterations, "optim.decay_iterations": iterations}
    return cfg.replace(lengths | {"schedule.half_resolution_iterations": iterations // 3})


def trained(name: str, folder: Path, backend: render.Backend, iterations: int | None, *, scored: bool) -> Run:
    """Train on one backend and score the result on the same device."""
    cfg = config(backend, iterations)
    sequence = load_sequence(folder, cfg.data)
    began = time.perf_counter()
    trainer = GaussianTrainer(sequence, cfg)
    on_gpu = trainer.device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(trainer.device)
    trainer.start()
    started = time.perf_counter()
    while not trainer.finished:
        trainer.step()
    scene = trainer.scene().to(trainer.device)
    wait_for(trainer.device)
    ended = time.perf_counter()
    found = evaluate(scene, sequence, networks=False).scores if scored else {}
    return Run(
        name=name, frames=len(sequence), start_s=started - began, loop_s=ended - started,
        iterations=cfg.schedule.fine_iterations, bits=digest(scene),
        memory_mb=torch.cuda.max_memory_allocated(trainer.device) / 1e6 if on_gpu else None,
        scores={name: found[name] for name in SCORES if name in found},
    )  # fmt: skip


def digest(scene: Scene) -> str:
    found = hashlib.sha256()
    for _, value in sorted(scene.gaussians.tensors.items()):
        found.update(value.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()[:12]


def table(runs: list[Run]) -> list[str]:
    names = [name for name in SCORES if any(name in run.scores for run in runs)]
    facts = ("`default` on", "frames", "start, s", "iterations, s", "iterations/s", "bits")
    lines = header(*facts, *names)
    for run in runs:
        cells = [run.name, str(run.frames), f"{run.start_s:.1f}", f"{run.loop_s:.1f}"]
        cells += [f"{run.iterations / max(run.loop_s, 1e-9):.0f}", run.note or run.bits]
        cells += [f"{run.scores[name]:.4g}" if name in run.scores else "" for name in names]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def header(*names: str) -> list[str]:
    return [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
