"""Time the CPU renderer, stage by stage, on a random scene; with `--yardstick PATH`, beside another compositing kernel.

    OMP_WAIT_POLICY=PASSIVE python bench/bench_render.py [--gaussians 25000] [--size 640 512] [--yardstick PATH]

Prints medians in ms. The yardstick module is run alternately with ours in this process, on its own scene; it must have
`scene(N, W, H)`, `forward`, `backward`, and the tables `PX`, `PY`. Without OMP_WAIT_POLICY=PASSIVE, idle threads of
torch spin on the cores that Numba's threads need (each brings its own OpenMP), and everything takes up to three times
as long.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import torch

from endoprior.render import tiles
from endoprior.render.composite_backward import MOMENTS, composite_backward, gather
from endoprior.render.composite_forward import composite_forward
from endoprior.render.cpu import camera_arrays, rasterize
from endoprior.render.project_kernels import project_backward, project_forward
from endoprior.types import Camera, Splats

WARM_UP = 3
"""Rounds that are not counted: compilation, first touch of memory."""


def random_scene(num: int, width: int, height: int, seed: int = 0) -> tuple[Splats, Camera]:
    """Gaussians spread evenly over the image at 40-80 mm, about 2.6 px wide, opacity 0.2-0.95, SH degree 3."""
    rng = np.random.default_rng(seed)
    camera = Camera(width, height, 570.0, 570.0, width / 2, height / 2, np.eye(4))
    z = rng.uniform(40, 80, num)
    x = (rng.uniform(0, width, num) - camera.cx) / camera.fx * z
    y = (rng.uniform(0, height, num) - camera.cy) / camera.fy * z
    scales = np.exp(rng.normal(np.log(2.6), 0.4, (num, 3))) * (z / camera.fx)[:, None]
    values = (
        np.stack([x, y, z], -1),
        rng.normal(size=(num, 4)),
        scales,
        rng.uniform(0.2, 0.95, num),
        rng.normal(size=(num, 16, 3)) * 0.2,
    )
    return Splats(*(torch.tensor(v, dtype=torch.float32) for v in values)), camera


class Clock:
    """Collects milliseconds by name."""

    def __init__(self) -> None:
        self.laps: dict[str, list[float]] = defaultdict(list)

    def run(self, name: str, work: Callable[..., Any], *args: Any) -> Any:
        """Call `work(*args)`, note how long it took, return its result."""
        start = time.perf_counter()
        result = work(*args)
        self.laps[name].append(1e3 * (time.perf_counter() - start))
        return result

    def median(self, name: str) -> float:
        """Median of the counted laps, ms."""
        return statistics.median(self.laps[name][WARM_UP:])


class Compositing:
    """Our compositing of Gaussians that are already in the image, with its buffers."""

    def __init__(self, gaussians: tuple[np.ndarray, ...], width: int, height: int, cotangents: np.ndarray) -> None:
        """gaussians: means2d, row_forms, z, colors, opacities, radii; cotangents: (H, W, 5) of color, depth, alpha."""
        self.gaussians, self.size = gaussians, (width, height)
        self.v_color, self.v_depth, self.v_alpha = (np.ascontiguousarray(cotangents[..., c]) for c in (slice(3), 3, 4))
        self.color = np.empty((height, width, 3), np.float32)
        self.depth, self.transmittance = np.empty((2, height, width), np.float32)
        self.background, self.workers = np.zeros(3, np.float32), numba.get_num_threads()

    def build(self) -> None:
        """Sort into tiles."""
        self.tiles = tiles.build(*self.gaussians, *self.size)
        self.lists = (self.tiles.records, self.tiles.pairs, self.tiles.tile_starts)
        self.tile_ends = np.empty(len(self.tiles.by_cost), np.int64)
        self.moments = np.empty((len(self.tiles.pairs), MOMENTS), np.float32)

    def forward(self) -> None:
        """Draw."""
        picture = (self.background, self.color, self.depth, self.transmittance)
        composite_forward(*self.lists, self.tiles.by_cost, self.workers, *picture, self.tile_ends)

    def backward(self) -> None:
        """Moments of every pair."""
        cotangents = (self.v_color, self.v_depth, self.v_alpha)
        picture = (self.color, self.depth, self.transmittance)
        lists = (*self.lists, self.tile_ends, self.tiles.by_cost)
        composite_backward(*lists, self.workers, *picture, *cotangents, self.moments)

    def gather(self) -> list[np.ndarray]:
        """Gradients of means2d, row_forms, opacities, colors, z."""
        num = len(self.gaussians[0])
        grads = [np.empty(shape, np.float32) for shape in [(num, 2), (num, 3), (num,), (num, 3), (num,)]]
        gather(self.moments, self.tiles.slot_starts, self.gaussians[1], self.gaussians[4], *grads)
        return grads


def time_stages(num: int, width: int, height: int, repeats: int) -> None:
    """Each kernel on its own, then a whole picture with its gradients as training sees it."""
    splats, camera = random_scene(num, width, height)
    cotangents = np.random.default_rng(1).normal(size=(height, width, 5)).astype(np.float32)
    inputs = [t.numpy() for t in (splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)]
    view = camera_arrays(camera)
    shapes = [(num, 2), (num, 3), (num,), (num, 3)]
    means2d, row_forms, z, colors = (np.empty(shape, np.float32) for shape in shapes)
    radii = np.empty(num, np.int32)
    ours = Compositing((means2d, row_forms, z, colors, inputs[3], radii), width, height, cotangents)
    trained = [t.clone().requires_grad_() for t in (splats.means, splats.quats, splats.scales)]
    trained += [t.clone().requires_grad_() for t in (splats.opacities, splats.sh)]
    v_color, v_depth = torch.tensor(cotangents[..., :3]), torch.tensor(cotangents[..., 3])

    def draw() -> Any:
        return rasterize(Splats(*trained), camera, background=torch.zeros(3))

    clock = Clock()
    for _ in range(WARM_UP + repeats):
        outputs = (means2d, row_forms, z, colors, radii)
        clock.run("project", project_forward, *inputs, *view, width, height, *outputs)
        clock.run("sort into tiles", ours.build)
        clock.run("composite", ours.forward)
        clock.run("composite, backward", ours.backward)
        v_means2d, v_row_forms, _, v_colors, v_z = clock.run("gather", ours.gather)
        grads = [np.empty_like(inputs[i]) for i in (0, 1, 2, 4)]
        world = (*inputs[:3], inputs[4], *view, radii, v_means2d, v_row_forms, v_z, v_colors)
        clock.run("project, backward", project_backward, *world, *grads)
        out = clock.run("whole, forward", draw)
        clock.run("whole, backward", torch.autograd.backward, [out.color, out.depth], [v_color, v_depth])
    waiting = os.environ.get("OMP_WAIT_POLICY", "not set")
    print(f"{num} Gaussians, {width}x{height}, {len(ours.tiles.pairs)} pairs, median of {repeats}, ms")
    print(f"{numba.get_num_threads()} threads, OMP_WAIT_POLICY {waiting}")
    stages = [name for name in clock.laps if "whole" not in name]
    everything = sum(clock.median(name) for name in stages)
    for name in clock.laps:
        share = f"{clock.median(name) / everything:6.1%}" if name in stages else ""
        print(f"  {name:20s} {clock.median(name):7.2f}  {share}")


def time_beside(yardstick: ModuleType, num: int, width: int, height: int, repeats: int) -> None:
    """Ours and the yardstick's compositing in turn, on the yardstick's scene."""
    xy, conics, opacities, colors, starts, ids = scene = yardstick.scene(num, width, height)
    # The yardstick's fourth channel is not what it sorts by: the order has to be read from its tile lists, and the
    # channel put in place of z afterwards.
    rank = near_to_far_rank(starts, ids, num)
    a, b, c = conics.astype(np.float64).T
    row_forms = np.stack([a, b / a, c - b * b / a], -1).astype(np.float32)
    cotangents = np.random.default_rng(1).normal(size=(height, width, 5)).astype(np.float32)
    gaussians = (xy, row_forms, rank, np.ascontiguousarray(colors[:, :3]), opacities, np.ones(num, np.int32))
    ours = Compositing(gaussians, width, height, cotangents)
    picture, transmittance = np.zeros((4, height, width), np.float32), np.zeros((height, width), np.float32)
    last, rows = np.zeros(len(starts) - 1, np.int64), np.zeros((len(ids), 10), np.float32)
    tables = (width, height, yardstick.PX, yardstick.PY, picture, transmittance, last)
    v_picture, v_transmittance = np.ascontiguousarray(np.moveaxis(cotangents[..., :4], -1, 0)), -cotangents[..., 4]

    clock = Clock()
    for _ in range(WARM_UP + repeats):
        clock.run("theirs", yardstick.forward, *scene, *tables)
        clock.run("theirs, backward", yardstick.backward, *scene, *tables, v_picture, v_transmittance, rows)
        ours.build()
        ours.tiles.records[:, tiles.Z] = colors[:, 3]
        clock.run("ours", ours.forward)
        clock.run("ours, backward", ours.backward)
    laps = {name: np.array(laps[WARM_UP:]) for name, laps in clock.laps.items()}
    for direction in ("", ", backward"):
        mine, yours = np.median(laps["ours" + direction]), np.median(laps["theirs" + direction])
        print(f"  compositing{direction:11s} ours {mine:6.2f}  theirs {yours:6.2f}  ratio {mine / yours:.3f}")
    mine, yours = laps["ours"] + laps["ours, backward"], laps["theirs"] + laps["theirs, backward"]
    print(f"  forward + backward     ratio {np.median(mine) / np.median(yours):.3f}")
    gap = np.abs(np.moveaxis(picture[:3], 0, -1) - ours.color).max(-1)
    print(
        f"  largest difference in color {gap.max():.1e}; {np.mean(gap > 1e-4):.2%} of pixels differ by more than 1e-4"
    )


def near_to_far_rank(starts: np.ndarray, ids: np.ndarray, num: int) -> np.ndarray:
    """(N,) float32 > 0 that sorts the Gaussians of every tile as its list does.

    Repeated relaxation: each Gaussian comes after its predecessor in each list, so its rank is the longest chain of
    predecessors.
    """
    rank = np.ones(num, np.float32)
    inner = np.ones(len(ids), bool)
    inner[starts[:-1][starts[:-1] < len(ids)]] = False  # the first of each list has no predecessor
    before, after = ids[np.flatnonzero(inner) - 1], ids[inner]
    while True:
        longer = rank.copy()
        np.maximum.at(longer, after, rank[before] + 1)
        if (longer == rank).all():
            return rank
        rank = longer


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=25_000)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 512), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--repeats", type=int, default=25)
    parser.add_argument("--yardstick", type=Path)
    options = parser.parse_args()
    time_stages(options.gaussians, *options.size, options.repeats)
    if options.yardstick:
        spec = importlib.util.spec_from_file_location("yardstick", options.yardstick)
        yardstick = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(yardstick)
        time_beside(yardstick, options.gaussians, *options.size, options.repeats)


if __name__ == "__main__":
    main()
