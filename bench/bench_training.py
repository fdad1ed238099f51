"""Time the parts of an iteration that are not drawing or deforming, each beside plain torch in the same process.

`python bench/bench_training.py [SEQUENCE]` prints median milliseconds; with a sequence folder also whole iterations of
the `default` preset on it.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import torch

from endoprior import losses, temporal
from endoprior.config import TemporalConfig
from endoprior.loss_kernels import supervised_losses
from endoprior.optim import AdamState

HEIGHT, WIDTH, NUM, WARM_UP, REPEATS = 512, 640, 20_000, 3, 15


def median_ms(run: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median wall time of `run`, ms, after a warm-up."""
    times = []
    for k in range(WARM_UP + repeats):
        began = time.perf_counter()
        run()
        if k >= WARM_UP:
            times.append(time.perf_counter() - began)
    return 1e3 * statistics.median(times)


def bench_losses() -> tuple[float, float]:
    """Fused kernel and torch definition of the supervised terms, forward and backward."""
    g = torch.Generator().manual_seed(0)
    color = torch.rand(HEIGHT, WIDTH, 3, generator=g).requires_grad_()
    depth = (torch.rand(HEIGHT, WIDTH, generator=g) * 60 + 40).requires_grad_()
    target = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=g, dtype=torch.uint8)
    inverse = 1 / (torch.rand(HEIGHT, WIDTH, generator=g) * 60 + 40)
    mask = torch.rand(HEIGHT, WIDTH, generator=g) < 0.9

    def fused() -> None:
        supervised_losses(color, depth, target, inverse, mask, mask, (1.0, 1.0, 0.03)).sum().backward()

    def definition() -> None:
        drawn = losses.inverse_depth(depth)
        total = losses.color_l1(color, target.float() / 255, mask) + losses.inverse_depth_l1(drawn, inverse, mask, 10)
        (total + 0.03 * (losses.total_variation(color) + losses.total_variation(drawn))).backward()

    return median_ms(fused), median_ms(definition)


def bench_adam() -> tuple[float, float]:
    """One-pass Adam and torch's, over the temporal coefficients of 20,000 Gaussians (8 million numbers)."""
    param = torch.rand(NUM, 31, 13).requires_grad_()
    param.grad = torch.rand_like(param)
    state = AdamState(param)
    other = param.detach().clone().requires_grad_()
    other.grad = param.grad.clone()
    torch_adam = torch.optim.Adam([other], lr=1e-3, eps=1e-15)
    return median_ms(lambda: state.update(param, 1e-3, 1e-15)), median_ms(torch_adam.step)


def bench_temporal(num_points: int) -> float:
    """Neighbors, affinities, loss and gradient of Eq. (11) for a set of points."""
    cfg = TemporalConfig()
    before = torch.rand(num_points, 3, generator=torch.Generator().manual_seed(0)) * 60
    now = (before + 0.1 * torch.rand(num_points, 3)).requires_grad_()

    def run() -> None:
        indices, distances = temporal.neighbors(before.numpy(), cfg.num_neighbors)
        weights = temporal.affinity(distances, indices, np.ones(num_points))
        sum(temporal.local_motion_loss(now, before, indices, weights, cfg)).backward()

    return median_ms(run)


def bench_iterations(sequence: Path) -> float:
    """Whole iterations of `default` at full resolution on a real sequence."""
    from dataclasses import replace

    from endoprior.data import load_sequence
    from endoprior.presets import preset
    from endoprior.trainer import Trainer

    cfg = preset("default")
    cfg = replace(
        cfg,
        schedule=replace(cfg.schedule, half_resolution_iterations=0),
        temporal=replace(cfg.temporal, start_iteration=1),
    )
    trainer = Trainer(load_sequence(sequence), cfg)
    trainer.start()
    return median_ms(trainer.step, 60)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", type=Path, nargs="?")
    args = parser.parse_args()
    print(
        f"{WIDTH}x{HEIGHT}, {NUM} Gaussians, {numba.get_num_threads()} Numba threads, {torch.get_num_threads()} torch"
    )
    for name, (ours, theirs) in (("losses, forward + backward", bench_losses()), ("Adam, 8.06 M", bench_adam())):
        print(f"{name:<32}{ours:8.1f} ms   plain torch {theirs:8.1f} ms   ratio {ours / theirs:.2f}")
    for num in (1024, NUM):
        print(f"{f'temporal term, {num} points':<32}{bench_temporal(num):8.1f} ms")
    if args.sequence:
        print(f"{'whole iteration, default':<32}{bench_iterations(args.sequence):8.1f} ms")


if __name__ == "__main__":
    main()
