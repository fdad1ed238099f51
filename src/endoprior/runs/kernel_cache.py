"""Compile Numba's kernels in a separate process, so that every run, the first one too, loads them from the cache.

The code that Numba compiles in a process is not always the code that it loads from its cache in the next one: parallel
loops are optimized once more when they are linked for the cache, and sums that may be reordered then differ in their
last bits. A run and its repetition, or its resumed part, must not use both (docs/log.md).

`python -m endoprior.runs.kernel_cache < config.json` compiles every kernel by training and scoring something tiny, and
prints how many it has compiled.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.config import Config
from ..core.config_io import to_dict
from ..core.types import Camera, Frame
from ..data import FrameSequence
from ..model.method import config_from, method_of
from ..render import ON_GPU
from ..system.console import say
from ..system.file_lock import exclusive
from ..system.surroundings import python_command

PACKAGE = Path(__file__).parents[1]
WITH_KERNELS = ("compute", "evaluation", "initialization", "model", "render", "training")
"""The parts of the package that hold kernels, or decide with which types they are called."""
LIMIT_S = 900.0
"""Longest time to wait, s; then, or when the process fails, kernels are compiled when they are first used."""
USUAL_COUNT = 112
"""Number of kernels that `default` needs, each counted with every type of its arguments; other presets differ."""
WIDTH, HEIGHT, FRAMES = 64, 48, 10  # size of what is trained to compile, px, and its number of frames
_filled: set[str] = set()


def is_filled(cfg: Config) -> bool:
    """Whether the kernels that training and scoring with `cfg` need are in Numba's cache, or cannot be there."""
    if cfg.render.backend in ON_GPU or not method_of(cfg).has_gaussians:  # which need no Numba kernels
        return True
    key = _key(cfg)
    return key in _filled or _marker(key).exists()


def fill(
    cfg: Config,
    say: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> None:
    """Make sure that the kernels which training and scoring with `cfg` need are in Numba's cache.

    Args:
        say: takes one line if they must be compiled.
        progress: is told how many are compiled, and about how many there are.
    """
    if is_filled(cfg):
        return
    _filled.add(key := _key(cfg))
    marker = _marker(key)
    with suppress(OSError, subprocess.SubprocessError):  # a read-only folder: Numba caches nothing either
        marker.parent.mkdir(parents=True, exist_ok=True)
        with exclusive(marker.with_suffix(".lock"), LIMIT_S):
            if marker.exists():
                return
            say("compiling kernels, once after installation (about a minute)")
            if _compile(json.dumps(to_dict(cfg)), progress):
                marker.touch()


def _compile(config: str, progress: Callable[[int, int], None]) -> bool:
    """Compile the kernels of a config in another process; whether it succeeded."""
    words = python_command("endoprior.runs.kernel_cache")
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(words, text=True, encoding="utf-8", **pipes) as process:
        limit = threading.Timer(LIMIT_S, process.kill)
        limit.start()
        try:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write(config)
            process.stdin.close()
            for line in process.stdout:
                if line.strip().isdigit():
                    progress(int(line), max(int(line), USUAL_COUNT))
            return process.wait() == 0
        except BaseException:  # an interruption: it must not compile on
            process.kill()
            raise
        finally:
            limit.cancel()


def _marker(key: str) -> Path:
    """The file that says that kernels are compiled, where Numba keeps those of this package."""
    beside = PACKAGE / "__pycache__" if os.access(PACKAGE, os.W_OK) else Path(os.path.expanduser("~/.cache/endoprior"))
    return Path(os.environ.get("NUMBA_CACHE_DIR") or beside) / f"endoprior_{key}.ready"


def _key(cfg: Config) -> str:
    """Hash of everything that decides which kernels are needed: source, compiler, processor, parts of the config.

    Numbers of the config decide nothing, only which parts it uses: presets that differ in numbers share their kernels.
    """
    import llvmlite.binding
    import numba

    digest = hashlib.sha256()
    for file in sorted(file for part in WITH_KERNELS for file in (PACKAGE / part).rglob("*.py")):
        name, facts = file.relative_to(PACKAGE).as_posix(), file.stat()
        digest.update(f"{name} {facts.st_size} {facts.st_mtime_ns}".encode())
    digest.update(f"{numba.__version__} {llvmlite.binding.get_host_cpu_name()} {sys.version}".encode())
    deformation = to_dict(cfg.deformation)
    if deformation["kind"] == "hexplane":  # has a kernel for each number of planes
        digest.update(json.dumps(deformation).encode())
    parts = (cfg.render, {"sh_degree": cfg.schedule.sh_degree}, {"temporal": cfg.temporal.weight})
    used = [_used(part if isinstance(part, dict) else to_dict(part)) for part in parts]
    switches = {name: value for name, value in deformation.items() if name not in ("basis", "hexplane")}
    words = (cfg.method, cfg.init.motion, cfg.temporal.gradient, _used(switches), used)
    digest.update(json.dumps(words).encode())
    return digest.hexdigest()[:16]


def _used(values: dict[str, Any]) -> dict[str, Any]:
    """Values of a config with every number replaced by whether it is above 0."""
    return {
        name: value > 0 if isinstance(value, int | float) and not isinstance(value, bool) else value
        for name, value in values.items()
    }


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
    )


def main() -> None:
    """Read the config, train, score; print a count after each kernel."""
    from numba.core import event

    from ..evaluation.scoring import evaluate  # which takes long to import
    from ..training.method import trainer_for

    class Counting(event.Listener):
        """Prints how many kernels have been compiled so far."""

        def __init__(self) -> None:
            self.count = 0

        def on_start(self, _event: event.Event) -> None:
            """A kernel begins."""

        def on_end(self, _event: event.Event) -> None:
            """A kernel is there."""
            self.count += 1
            say(str(self.count))

    cfg, sequence = shortened(config_from(json.load(sys.stdin))), tiny_sequence()
    with event.install_listener("numba:compile", Counting()):
        trainer = trainer_for(sequence, cfg)
        trainer.start()
        while not trainer.finished:
            trainer.step()
        evaluate(trainer.scene(), sequence, networks=False)


if __name__ == "__main__":
    main()
