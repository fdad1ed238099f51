"""How strongly each term of the loss pulls on the Gaussians, beside the color term.

`python bench/term_gradients.py DATA [--preset NAME] [--seed N] [--set FIELD=VALUE ...]`

Trains, and at a few iterations of the fine stage differentiates every term on its own by the centers of the Gaussians
at the frame. Printed are the norms over all Gaussians as shares of the color term's: medians over `FRAMES` iterations
in a row. For the temporal term also the weights at which its share would be 1 %, 10 % and 50 %: it is linear in its
weight.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from statistics import median

import common  # noqa: F401, before torch
import numpy as np
import torch
import yaml

from endoprior.data import load_sequence
from endoprior.model.presets import preset
from endoprior.training import losses
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.trainer import Stage, stage_length

AT = (0.25, 0.5, 0.75, 1.0)
"""Shares of the fine stage."""
FRAMES = 9
TEMPORAL = ("displacement", "distance")
"""The parts of the temporal term."""
WANTED = (0.01, 0.1, 0.5)


def shares(trainer: GaussianTrainer) -> dict[str, float]:
    """Norm of the gradient of each term in the next iteration, as a share of the color term's."""
    # The compiled loss differentiates its terms together.
    apart = replace(trainer.ops, supervised_losses=losses.supervised_losses)
    step, state = replace(trainer.step_once, ops=apart), trainer.state
    forward = step.forward(state, np.random.default_rng([trainer.cfg.seed, int(state.stage), state.iteration + 1]))
    norms = {}
    for name, term in step.loss(state, forward)[0].items():
        if term.requires_grad:
            (gradient,) = torch.autograd.grad(term, forward.splats.means, retain_graph=True, allow_unused=True)
            norms[name] = 0.0 if gradient is None else float(gradient.norm())
    return {name: norm / norms["color"] for name, norm in norms.items()}


def measure(trainer: GaussianTrainer) -> dict[int, dict[str, float]]:
    """Train to the end; the median shares by iteration of the fine stage."""
    total = stage_length(trainer.cfg, Stage.FINE)
    ends = [round(share * total) for share in AT]
    found: dict[int, dict[str, list[float]]] = {end: defaultdict(list) for end in ends}
    trainer.start()
    while not trainer.finished:
        state = trainer.state
        for end in ends:
            if state.stage is Stage.FINE and end - FRAMES <= state.iteration < end:
                for name, share in shares(trainer).items():
                    found[end][name].append(share)
        trainer.step()
    return {end: {name: median(values) for name, values in terms.items()} for end, terms in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE")
    args = parser.parse_args()
    changes = (text.partition("=") for text in args.set)
    changed = {name: yaml.safe_load(value) for name, _, value in changes}
    cfg = preset(args.preset, seed=args.seed).replace(changed)
    by_iteration = measure(GaussianTrainer(load_sequence(args.data, cfg.data), cfg))
    names = sorted({name for terms in by_iteration.values() for name in terms})
    print("iteration".ljust(12), *(name.rjust(12) for name in names))
    for iteration, terms in by_iteration.items():
        print(str(iteration).ljust(12), *(f"{terms.get(name, 0):12.3g}" for name in names))
    if temporal := [total for terms in by_iteration.values() if (total := sum(terms.get(n, 0) for n in TEMPORAL))]:
        typical = median(temporal)
        weights = ", ".join(f"{cfg.temporal.weight * want / typical:.2g} for {want:.0%}" for want in WANTED)
        print(f"temporal weight {cfg.temporal.weight:g}: median share {typical:.2g}; weights: {weights}")


if __name__ == "__main__":
    main()
