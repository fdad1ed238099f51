"""Milliseconds of the deformation fields beside torch's `grid_sample` on the same planes, in the same process.

Run: `python bench/bench_deformation.py [--num 20000] [--repeats 5] [--threads 2]`. Gaussians lie on a bumpy sheet in
random order, as they do on tissue; `--volume` scatters them through the box instead.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable

import numba
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from endoprior.config import DeformationConfig
from endoprior.model.basis import basis_offsets, identity_motion
from endoprior.model.deformation import HexPlaneField
from endoprior.model.hexplane import PLANE_NAMES, PlaneGrid
from endoprior.model.plane_adam import PlaneAdam


def median_ms(action: Callable[[], object], repeats: int) -> float:
    """Median milliseconds of `action`, after one call that is not counted."""
    action()
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        taken.append(1e3 * (time.perf_counter() - start))
    return sorted(taken)[repeats // 2]


def torch_features(planes: list[list[Tensor]], unit: Tensor, moment: float) -> Tensor:
    """The same features by `grid_sample`; planes are (1, C, rows, columns)."""
    where = torch.cat([unit * 2 - 1, torch.full_like(unit[:, :1], moment)], -1)
    features = []
    for scale in planes:
        product = 1.0
        for name, plane in zip(PLANE_NAMES, scale, strict=True):
            axes = where[:, ["xyzt".index(axis) for axis in name]][None, None]
            sample = grid_sample(plane, axes, mode="bilinear", padding_mode="border", align_corners=True)
            product = product * sample[0, :, 0]
        features.append(product.T)
    return torch.cat(features, -1)


def main() -> None:
    """Print one line per measurement."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=numba.get_num_threads())
    parser.add_argument("--volume", action="store_true")
    parser.add_argument("--no-torch", action="store_true")
    args = parser.parse_args()
    numba.set_num_threads(args.threads)
    torch.set_num_threads(args.threads)

    cfg, generator = DeformationConfig(), torch.Generator().manual_seed(0)
    means = torch.rand(args.num, 3, generator=generator) * torch.tensor([60.0, 50.0, 20.0])
    if not args.volume:
        means[:, 2] = 60 + 8 * torch.sin(means[:, 0] / 9) * torch.cos(means[:, 1] / 7) + means[:, 2] / 40
    start = time.perf_counter()
    field = HexPlaneField.from_points(means, cfg, generator)
    print(f"{args.num} Gaussians, {field.num_plane_values:,} plane numbers, {args.threads} threads")
    print(f"create field        {1e3 * (time.perf_counter() - start):8.1f} ms")
    unit = ((means - field.box[0]) / (field.box[1] - field.box[0])).detach().requires_grad_(True)
    cotangent = torch.randn(args.num, field.grid.num_features, generator=generator)

    report("hexplane", args.repeats, lambda t: field.grid.sample(unit, t), cotangent)
    report("field offsets", args.repeats, lambda t: field.offsets(means, t).means, torch.ones(args.num, 3))
    with torch.no_grad():
        print(f"field render        {median_ms(lambda: field.offsets(means, 0.4), args.repeats):8.1f} ms")
    adam = PlaneAdam(field.grid)
    for k in range(60):
        field.grid.sample(unit, k / 63).sum().backward()
        adam.step(1e-3)
    touched = field.grid.marks.count_nonzero() / len(field.grid.marks)
    taken = []
    for k in range(args.repeats):
        field.grid.sample(unit, k / 63).sum().backward()
        start = time.perf_counter()
        adam.step(1e-3)
        taken.append(1e3 * (time.perf_counter() - start))
    print(f"plane adam          {sorted(taken)[args.repeats // 2]:8.1f} ms, {touched:.1%} of cells touched")

    motion = identity_motion(args.num, cfg).requires_grad_(True)
    report("basis", args.repeats, lambda t: basis_offsets(motion, t, cfg).means, torch.ones(args.num, 3))
    print(f"peak resident       {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:8.2f} GiB")
    if not args.no_torch:
        planes = torch_planes(field.grid)
        report("torch grid_sample", args.repeats, lambda t: torch_features(planes, unit, t), cotangent)


def torch_planes(grid: PlaneGrid) -> list[list[Tensor]]:
    """Copies of the planes in the layout of `grid_sample`."""
    return [
        [grid.plane(s, name).permute(2, 0, 1)[None].contiguous().requires_grad_(True) for name in PLANE_NAMES]
        for s in range(grid.num_scales)
    ]


def report(label: str, repeats: int, forward: Callable[[float], Tensor], cotangent: Tensor) -> None:
    """Print the forward time, and that of forward plus backward less it."""
    once = median_ms(lambda: forward(0.4), repeats)
    both = median_ms(lambda: forward(0.4).backward(cotangent), repeats)
    print(f"{label:19s} {once:8.1f} ms forward, {both - once:8.1f} ms backward")


if __name__ == "__main__":
    main()
