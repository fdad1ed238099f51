"""Compile every kernel by training and scoring something tiny: `python -m endoprior.runs.warm_up < config.json`."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core.config import Config
from ..core.types import Camera, Frame
from ..data import FrameSequence
from ..evaluation.scoring import evaluate
from ..model.method import config_from, method_of

WIDTH, HEIGHT, FRAMES = 64, 48, 10


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
        init=replace(cfg.init, budget=400, cleanup=False, erosion_px=3),
        schedule=replace(cfg.schedule, coarse_iterations=2, fine_iterations=8, half_resolution_iterations=1),
        density=replace(cfg.density, start_iteration=0, every=3, grow_threshold=1e-7),
        temporal=replace(cfg.temporal, start_iteration=2, min_points=8, min_valid=0),
        loss=replace(cfg.loss, min_depth_pixels=1),
    )


def main() -> None:
    """Read the config, train, score."""
    cfg, sequence = shortened(config_from(json.load(sys.stdin))), tiny_sequence()
    trainer = method_of(cfg).trainer(sequence, cfg)
    trainer.start()
    while not trainer.finished:
        trainer.step()
    evaluate(trainer.scene(), sequence, networks=False)


if __name__ == "__main__":
    main()
