"""Have Numba's kernels compiled by a process of their own, so that every run, the first one too, loads them.

Code that was compiled in a process is not always the code that Numba loads from its cache in the next one: kernels of
parallel loops are optimized once more when they are linked for the cache, and sums that may be reordered then differ in
their last bits. Whoever compares a run with its repetition, or resumes it, must not meet both (docs/log.md).
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from filelock import FileLock

from ..core.config import Config
from ..core.config_io import to_dict
from ..render import ON_GPU

PACKAGE = Path(__file__).parents[1]
LIMIT_S = 900.0
"""Longest wait; then, or when the process fails, kernels are compiled where they are needed."""
_filled: set[str] = set()


def fill(cfg: Config, say: Callable[[str], None] = lambda text: None) -> None:
    """Make sure that the kernels which training and scoring with `cfg` need are in Numba's cache.

    Does nothing where that was done before, and after the first time in a process.

    Args:
        say: told once if there is something to wait for.
    """
    if cfg.render.backend in ON_GPU:  # which needs no kernels of ours
        return
    key = _key(cfg)
    if key in _filled:
        return
    _filled.add(key)
    with suppress(OSError, subprocess.SubprocessError):  # a folder nobody may write to: Numba caches nothing either
        marker = _cache_folder() / f"endoprior_{key}.ready"
        if marker.exists():
            return
        marker.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(marker.with_suffix(".lock")):
            if marker.exists():
                return
            say("compiling kernels, once after installation (about a minute)")
            words = [sys.executable, "-m", "endoprior.runs.warm_up"]
            told = json.dumps(to_dict(cfg))
            done = subprocess.run(words, input=told, text=True, capture_output=True, timeout=LIMIT_S, check=False)
            if done.returncode == 0:
                marker.touch()


def _key(cfg: Config) -> str:
    """Of everything that decides which kernels there are: source, compiler, processor, and parts of the config."""
    import llvmlite.binding
    import numba

    digest = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        digest.update(f"{file.relative_to(PACKAGE)} {file.stat().st_size} {file.stat().st_mtime_ns}".encode())
    digest.update(f"{numba.__version__} {llvmlite.binding.get_host_cpu_name()} {sys.version}".encode())
    parts = (cfg.deformation, cfg.render, cfg.schedule.sh_degree, cfg.init.motion, cfg.temporal.gradient)
    digest.update(json.dumps([to_dict(part) for part in parts]).encode())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Where Numba keeps the kernels of this package: `NUMBA_CACHE_DIR`, or beside the source."""
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given)
    return PACKAGE / "__pycache__" if os.access(PACKAGE, os.W_OK) else Path.home() / ".cache" / "endoprior"
