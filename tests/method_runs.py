"""What the tests of every method share: a training that stops and resumes, and scenes that come back from disk."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import torch

from endoprior.core.config import Config
from endoprior.data import FrameSequence
from endoprior.model.scene import SingleScene
from endoprior.model.scene_file import load_scene
from endoprior.runs.train import train
from endoprior.training.trainer import Stage


def trained_and_resumed(sequence: FrameSequence, cfg: Config, folder: Path, stop_at: int) -> SingleScene:
    """Train, train again with an interruption in the fine stage, compare all bits, and load what was saved."""
    whole = train(sequence, cfg, folder / "whole")

    def stop(report, trainer):
        if report.stage is Stage.FINE and report.iteration == stop_at:
            signal.raise_signal(signal.SIGINT)  # Ctrl-C: the checkpoint of this iteration is written

    with pytest.raises(KeyboardInterrupt):
        train(sequence, cfg, folder / "parts", on_step=stop)
    assert (folder / "parts" / "checkpoint.safetensors").is_file()
    train(sequence, cfg, folder / "parts", resume=True)
    for scene in (load_scene(folder / name) for name in ("whole", "parts")):
        assert scene.config.method == cfg.method
        for name, value in arrays_of(whole).items():
            assert torch.equal(arrays_of(scene)[name], value), name
    assert torch.equal(scene.render(0.5).color, whole.render(0.5).color)
    return scene


def arrays_of(scene: SingleScene) -> dict[str, torch.Tensor]:
    """Tensors of the Gaussians and of the field."""
    return scene.gaussians.tensors | (scene.field.state_arrays() if scene.field else {})
