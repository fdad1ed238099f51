"""Trainings of a few iterations on the tiny sequence, in which every part of the method runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from endoprior.core.config import Config, DataConfig
from endoprior.data import load_sequence
from endoprior.model.presets import preset
from endoprior.training.gaussian_trainer import GaussianTrainer

KINDS = ("basis", "hexplane")
"""The deformation models."""


def tiny_config(kind: str, coarse: int = 6, fine: int = 14) -> Config:
    """A config in which everything happens within a few iterations: growth, pruning, the temporal term."""
    cfg = preset("released")
    deformation = replace(cfg.deformation, kind=kind)
    if kind == "hexplane":
        planes = replace(deformation.hexplane, time_resolution=6, channels=4, multires=(1, 2))
        deformation = replace(deformation, hexplane=planes)
    return replace(
        cfg,
        data=DataConfig(),
        init=replace(cfg.init, budget=300),
        released=replace(cfg.released, cleanup=False),
        deformation=deformation,
        density=replace(cfg.density, start_iteration=2, every=4, grow_threshold=2e-3),
        temporal=replace(cfg.temporal, start_iteration=3, min_points=20, weight=1e-3),
        schedule=replace(cfg.schedule, coarse_iterations=coarse, fine_iterations=fine, sh_every=4),
    )


def losses_of(folder: Path, cfg: Config) -> list[list[float]]:
    """Objective after each iteration, and the number of Gaussians."""
    trainer = GaussianTrainer(load_sequence(folder, cfg.data), cfg)
    trainer.start()
    rows = []
    while not trainer.finished:
        report = trainer.step()
        rows.append([sum(report.terms.values()), report.num_gaussians])
    return rows
