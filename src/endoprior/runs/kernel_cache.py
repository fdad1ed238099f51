"""Compile Numba's kernels in a separate process, so that every run, the first one too, loads them from the cache.

The code that Numba compiles in a process is not always the code that it loads from its cache in the next one: parallel
loops are optimized once more when they are linked for the cache, and sums that may be reordered then differ in their
last bits. A run and its repetition, or its resumed part, must not use both (docs/log.md).

`python -m endoprior.runs.kernel_cache < config.json` compiles every kernel by training and scoring something tiny.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core.config import Config
from ..core.config_io import to_dict
from ..core.types import Camera, Frame
from ..data import FrameSequence
from ..model.method import config_from, method_of
from ..render import ON_GPU
from ..system.file_lock import exclusive
from ..system.surroundings import python_command

PACKAGE = Path(__file__).parents[1]
LIMIT_S = 900.0
"""Longest time to wait, s; then, or when the process fails, kernels are compiled when they are first used."""
WIDTH, HEIGHT, FRAMES = 64, 48, 10  # size of what is trained to compile, px, and its number of frames
_filled: set[str] = set()


def fill(cfg: Config, say: Callable[[str], None] = lambda _: None) -> None:
    """Make sure that the kernels which training and scoring with `cfg` need are in Numba's cache.

    `say` takes one line if they must be compiled.
    """
    if cfg.render.backend in ON_GPU or not method_of(cfg).has_gaussians:  # which need no Numba kernels
        return
    if (key := _key(cfg)) in _filled:
        return
    _filled.add(key)
    with suppress(OSError, subprocess.SubprocessError):  # a read-only folder: Numba caches nothing either
        beside = PACKAGE / "__pycache__" if os.access(PACKAGE, os.W_OK) else Path.home() / ".cache" / "endoprior"
        folder = Path(os.environ.get("NUMBA_CACHE_DIR") or beside)  # where Numba keeps the kernels of this package
        marker = folder / f"endoprior_{key}.ready"
        if marker.exists():
            return
        marker.parent.mkdir(parents=True, exist_ok=True)
        with exclusive(marker.with_suffix(".lock"), LIMIT_S):
            if marker.exists():
                return
            say("compiling kernels, once after installation (about a minute)")
            config = json.dumps(to_dict(cfg))
            words = python_command("endoprior.runs.kernel_cache")
            done = subprocess.run(words, input=config.encode(), capture_output=True, timeout=LIMIT_S, check=False)
            if done.returncode == 0:
                marker.touch()


def _key(cfg: Config) -> str:
    """Hash of everything that decides which kernels are needed: source, compiler, processor, parts of the config."""
    import llvmlite.binding
    import numba

    digest = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        name, facts = file.relative_to(PACKAGE).as_posix(), file.stat()
        digest.update(f"{name} {facts.st_size} {facts.st_mtime_ns}".encode())
    digest.update(f"{numba.__version__} {llvmlite.binding.get_host_cpu_name()} {sys.version}".encode())
    temporal = (cfg.temporal.weight > 0, cfg.temporal.gradient)
    parts = (cfg.method, cfg.deformation, cfg.render, cfg.schedule.sh_degree, cfg.init.motion, *temporal)
    digest.update(json.dumps([to_dict(part) for part in parts]).encode())
    return digest.hexdigest()[:16]


def tiny_sequence() -> FrameSequence:
    """A sequence made in memory: textured, moving, with a tool and with missing depth."""
    camera = Camera(WIDTH, HEIGHT, 60.0, 60.0, WIDTH / 2, HEIGHT / 2, np.eye(4))
    y, x = np.mgrid[:HEIGHT, :WIDTH]

    def read_frame(index: int) -> Frame:
        shift = 2 * np.sin(index)
        waves = [np.sin((0.3 + 0.1 * c) * (x + shift)) * np.cos((0.2 + 0.1 * c) * y) for c in range(3)]
        rgb_u8 = np.clip(128 + 90 * np.stack(waves, -1), 0, 255).astype(np.uint8)
        depth = (50 + 3 * np.sin(0.1 * (x + shift))).astype(np.float32)
        valid, tissue = depth > 48, ~((x > 40) & (abs(y - 24) < 6))
        return Frame(index, index / FRAMES, camera, rgb_u8, tissue, np.where(valid, depth, 0), valid)

    return FrameSequence(Path("warm-up"), [camera] * FRAMES, read_frame)


def shortened(cfg: Config) -> Config:
    """The config with a few iterations in which everything runs: stages, growth, temporal term, half resolution."""
    return replace(
        cfg,
        data=replace(cfg.data, eyes="left"),
        init=replace(cfg.init, budget=400),
        released=replace(cfg.released, cleanup=False),
        schedule=replace(cfg.schedule, coarse_iterations=2, fine_iterations=8, half_resolution_iterations=1),
        density=replace(cfg.density, start_iteration=0, every=3, grow_threshold=1e-7),
        temporal=replace(cfg.temporal, start_iteration=2, min_points=8, min_valid=0),
        loss=replace(cfg.loss, min_depth_pixels=1),
    )


def main() -> None:
    """Read the config, train, score."""
    from ..evaluation.scoring import evaluate  # which takes long to import

    cfg, sequence = shortened(config_from(json.load(sys.stdin))), tiny_sequence()
    trainer = method_of(cfg).trainer(sequence, cfg)
    trainer.start()
    while not trainer.finished:
        trainer.step()
    evaluate(trainer.scene(), sequence, networks=False)


if __name__ == "__main__":
    main()
