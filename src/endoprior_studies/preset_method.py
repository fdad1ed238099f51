"""Our own training as a method: one preset."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from endoprior.core.config import Config
from endoprior.data import FrameSequence
from endoprior.model.scene import Scene


@dataclass(frozen=True)
class PresetMethod:
    """See `Method`."""

    options: Config

    def train(self, sequence: FrameSequence, options: Config, *, seed: int, out: Path) -> Scene:
        """Train, or resume from the checkpoint in `out`; the scene is on the device that trained it."""
        from endoprior.runs.train import train
        from endoprior.training.trainer import device_for

        resume = (out / "checkpoint.safetensors").exists()
        if not resume:
            shutil.rmtree(out, ignore_errors=True)
        scene = train(sequence, replace(options, seed=seed), out, resume=resume)
        return scene.to(device_for(options.render.backend))
