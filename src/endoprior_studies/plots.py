"""Plots: Gaussians against flow error for each budget, and curves over the held-out frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from endoprior.evaluation.registry import all_scores
from endoprior.system.atomic import whole_file

from .matrix import Matrix, frames_of
from .results import Results
from .spec import Cell

FLOW_SCORES = ("flow_error", "flow_error_raft_small", "flow_error_dis")
"""The figure shows the first of these that all methods have."""
CURVE_SCORE = "psnr_tissue"


def budget_figure(results: Results, path: Path) -> None:
    """Number of Gaussians against flow error: one line through the budgets of each method."""
    spec = results.spec

    def plot(axis: Axes, sequence: str) -> None:
        score = _flow_score(results, sequence)
        for method in spec.methods:
            budgets = spec.budgets or (None,)
            counts = [results.summary(sequence, b, method, "num_gaussians") for b in budgets]
            errors = [results.summary(sequence, b, method, score) for b in budgets]
            axis.errorbar(
                [c.mean for c in counts],
                [e.mean for e in errors],
                yerr=[e.std if math.isfinite(e.std) else 0 for e in errors],
                marker="o",
                capsize=2,
                label=spec.label(method),
            )
        axis.set_xlabel("Gaussians")
        axis.set_ylabel(all_scores()[score].heading())

    _panels(list(spec.sequences), plot, path)


def curve_figure(results: Results, matrix: Matrix, path: Path) -> None:
    """Tissue PSNR of each held-out frame, mean over seeds: one line for each method, at its last budget."""
    spec = results.spec
    budget = spec.budgets[-1] if spec.budgets else None

    def plot(axis: Axes, sequence: str) -> None:
        for method in spec.methods:
            curves = []
            for seed in spec.seeds:  # every fold has held-out frames of its own
                cells = [Cell(sequence, method, budget, seed, fold) for fold in spec.folds(sequence, method)]
                folders = [matrix.done[cell] for cell in cells if cell in matrix.done]
                curves.append({i: v for folder in folders for i, v in frames_of(folder).get(CURVE_SCORE, {}).items()})
            known = [curve for curve in curves if curve]
            if known:
                frames = sorted(set.intersection(*(set(curve) for curve in known)))
                means = [float(np.mean([curve[i] for curve in known])) for i in frames]
                axis.plot(frames, means, marker=".", label=spec.label(method))
        axis.set_xlabel("frame")
        axis.set_ylabel(all_scores()[CURVE_SCORE].heading())

    _panels(list(spec.sequences), plot, path)


def _flow_score(results: Results, sequence: str) -> str:
    cells = [cell for cell in results.scores if cell.sequence == sequence]
    return next((s for s in FLOW_SCORES if cells and all(s in results.scores[c] for c in cells)), FLOW_SCORES[-1])


def _panels(sequences: list[str], plot: Callable[[Axes, str], None], path: Path) -> None:
    """One panel for each sequence, side by side, with one legend."""
    # An own canvas: `pyplot` would choose a backend for the whole process.
    figure = Figure(figsize=(5 * len(sequences), 3.8), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(sequences), squeeze=False)[0]
    for axis, sequence in zip(axes, sequences, strict=True):
        plot(axis, sequence)
        axis.set_title(sequence, fontsize=10)
        axis.grid(alpha=0.3)
    handles, labels = axes[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 5), fontsize=8)
    with whole_file(path) as temporary:
        figure.savefig(temporary)
