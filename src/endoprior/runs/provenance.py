"""What must be known to repeat a run: config, versions, commit, backend, device and data."""

from __future__ import annotations

import sys
from importlib.metadata import version
from typing import Any

from ..core.config import Config
from ..core.config_io import to_dict
from ..data import FrameSequence
from ..render import ON_GPU
from ..system.devices import name_of
from ..system.installation import source_commit
from ..training.trainer import device_for


def run_facts(sequence: FrameSequence, cfg: Config, fingerprint: str) -> dict[str, Any]:
    """Contents of `config.json`: every config field, versions, commit, backend, device, and the data."""
    backend = cfg.render.backend
    names = ["endoprior", "torch", "numpy", "numba", "scipy", "opencv-python-headless"]
    names += [backend] if backend in ON_GPU else []
    return {
        "config": to_dict(cfg),
        "seed": cfg.seed,
        "backend": backend,
        "device": name_of(device_for(cfg.render.backend)),
        "commit": source_commit(),
        "versions": {name: version(name) for name in names} | {"python": sys.version.split()[0]},
        "data": {
            "path": str(sequence.path.resolve()),
            "fingerprint": fingerprint,
            "frames": len(sequence),
        },
    }
