"""Compositing, forward and backward, beside a plain torch compositor that works tile by tile under autograd.

    python bench/compositing.py [--quick] [--json FILE]
    python bench/compositing.py --yardstick PATH [--gaussians 25000] [--size 640 512] [--repeats 25]

The second form races ours against another compositing module on that module's own scene, and compares pictures and
gradients. It must have `scene(N, W, H)`, `forward`, `backward`, and the tables `PX`, `PY`.
"""

from __future__ import annotations

import importlib.util
import statistics
from collections import defaultdict
from pathlib import Path
from types import ModuleType

import common
import numba
import numpy as np
import plain
import scenes
import torch
from numpy.typing import NDArray

from endoprior.core.types import Camera, Splats
from endoprior.render import tiles
from endoprior.render.composite_backward import MOMENTS, composite_backward, gather
from endoprior.render.composite_forward import composite_forward
from endoprior.render.constants import STOP_TRANSMITTANCE
from endoprior.render.cpu import Project
from endoprior.render.projection import Projected, project

TORCH_MOST = 20_000
"""Gaussians; with more, autograd's memory alone takes torch from seconds to minutes."""


class Compositing:
    """Our compositing of Gaussians that are already in the image, with its buffers."""

    def __init__(self, gaussians: tuple[NDArray, ...], width: int, height: int, cotangents: NDArray) -> None:
        """gaussians: means2d, row_forms, z, colors, opacities, radii; cotangents: (H, W, 5) of color, depth, alpha."""
        self.gaussians, self.size = gaussians, (width, height)
        self.color = np.empty((height, width, 3), np.float32)
        self.depth, self.transmittance = np.empty((2, height, width), np.float32)
        self.background, self.workers = np.zeros(3, np.float32), numba.get_num_threads()
        self.pull(cotangents)
        self.build()

    def pull(self, cotangents: NDArray) -> None:
        """Take other cotangents."""
        self.cotangents = [np.ascontiguousarray(cotangents[..., c]) for c in (slice(3), 3, 4)]

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
        v_color, v_depth, v_alpha = self.cotangents
        picture = (self.color, self.depth, self.transmittance)
        lists = (*self.lists, self.tile_ends, self.tiles.by_cost)
        composite_backward(*lists, self.workers, *picture, v_color, v_depth, v_alpha, self.moments)

    def gather(self) -> list[NDArray]:
        """Gradients of means2d, row_forms, opacities, colors, z."""
        num = len(self.gaussians[0])
        grads = [np.empty(shape, np.float32) for shape in [(num, 2), (num, 3), (num,), (num, 3), (num,)]]
        gather(self.moments, self.tiles.slot_starts, self.gaussians[1], self.gaussians[4], *grads)
        return grads


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """Two rows for each size; backward counts the sum of the pairs per Gaussian."""
    measured = []
    for size in sizes:
        splats, camera = scenes.splats(size)
        cotangents = np.random.default_rng(1).normal(size=(size.height, size.width, 5)).astype(np.float32)
        projected = Project.apply(splats.means, splats.quats, splats.scales, splats.sh, splats.opacities, camera)
        means2d, row_forms, z, colors, radii = (t.numpy() for t in projected)
        arrays = (means2d, row_forms, z, colors, splats.opacities.numpy(), radii)
        ours = Compositing(arrays, size.width, size.height, cotangents)
        steps = {"forward": lambda _, o=ours: o.forward(), "backward": lambda _, o=ours: (o.backward(), o.gather())}
        theirs = torch_steps(splats, camera, cotangents) if size.num <= TORCH_MOST else None
        picture = (size.width, size.height)
        measured += common.rows("compositing", common.race(steps, theirs), size.num, picture)
    return measured


def torch_steps(splats: Splats, camera: Camera, cotangents: NDArray) -> common.Steps:
    """The same in plain torch."""
    seen, opacities = project(splats, camera), splats.opacities.clone().requires_grad_()
    bins = plain.bin_tiles(seen, opacities, camera.width, camera.height)
    inputs = [t.clone().requires_grad_() for t in (seen.means2d, seen.cov2d, seen.z, seen.colors)]
    given, background = Projected(*inputs, seen.radii), torch.zeros(3)
    v_color, v_depth, v_alpha = (torch.from_numpy(cotangents)[..., c] for c in (slice(3), 3, 4))
    return {
        "forward": lambda _: plain.composite(given, opacities, bins, background, camera.width, camera.height),
        "backward": lambda out: torch.autograd.grad(out, [*inputs, opacities], [v_color, v_alpha, v_depth]),
    }


class Beside:
    """Ours and another module's compositing of that module's own scene."""

    def __init__(self, yardstick: ModuleType, num: int, width: int, height: int, cotangents: NDArray) -> None:
        self.yardstick, self.scene = yardstick, yardstick.scene(num, width, height)
        xy, self.conics, opacities, self.colors, starts, self.ids = self.scene
        # The yardstick's fourth channel is not what it sorts by: the order has to be read from its tile lists, and the
        # channel put in place of z afterwards.
        rank = near_to_far_rank(starts, self.ids, num)
        a, b, c = self.conics.astype(np.float64).T
        row_forms = np.stack([a, b / a, c - b * b / a], -1).astype(np.float32)
        gaussians = (xy, row_forms, rank, np.ascontiguousarray(self.colors[:, :3]), opacities, np.ones(num, np.int32))
        self.ours = Compositing(gaussians, width, height, cotangents)
        self.ours.tiles.records[:, tiles.Z] = self.colors[:, 3]
        self.picture = np.zeros((4, height, width), np.float32)
        self.transmittance = np.zeros((height, width), np.float32)
        self.rows = np.zeros((len(self.ids), 10), np.float32)
        last = np.zeros(len(starts) - 1, np.int64)
        self.tables = (width, height, yardstick.PX, yardstick.PY, self.picture, self.transmittance, last)
        self.pull(cotangents)

    def pull(self, cotangents: NDArray) -> None:
        """Give both (H, W, 5) cotangents of color, depth, alpha."""
        self.ours.pull(cotangents)
        self.v_picture = np.ascontiguousarray(np.moveaxis(cotangents[..., :4], -1, 0))
        self.v_transmittance = -cotangents[..., 4]

    def steps(self) -> dict[str, common.Steps]:
        """What is raced; neither sums the gradient rows of the pairs."""
        cotangents = (self.v_picture, self.v_transmittance)
        theirs = {
            "forward": lambda _: self.yardstick.forward(*self.scene, *self.tables),
            "backward": lambda _: self.yardstick.backward(*self.scene, *self.tables, *cotangents, self.rows),
        }
        ours = {"forward": lambda _: self.ours.forward(), "backward": lambda _: self.ours.backward()}
        return {"theirs": theirs, "ours": ours}

    def gradients(self, cotangents: NDArray) -> dict[str, tuple[NDArray, NDArray]]:
        """Ours and theirs per Gaussian, by name."""
        self.pull(cotangents)
        self.rows[:] = 0
        for steps in self.steps().values():
            common.lap(steps)
        v_means2d, v_row_forms, v_opacities, v_colors, v_z = (v.astype(np.float64) for v in self.ours.gather())
        theirs = np.zeros((len(self.conics), 10))
        np.add.at(theirs, self.ids, self.rows)
        # Row form (a, k, m) = (A, B / A, C - B^2 / A) of the conic (A, B, C): chain rule back to the conic.
        a, b, _ = self.conics.astype(np.float64).T
        v_a, v_k, v_m = v_row_forms.T
        v_conics = np.stack([v_a + (v_m * b - v_k) * b / a**2, (v_k - 2 * v_m * b) / a, v_m], -1)
        ours = {"means2d": v_means2d, "conics": v_conics, "opacities": v_opacities[:, None]}
        ours["colors, depth"] = np.column_stack([v_colors, v_z])
        columns = dict(zip(ours, (slice(0, 2), slice(2, 5), slice(5, 6), slice(6, 10)), strict=True))
        return {name: (mine, theirs[:, columns[name]]) for name, mine in ours.items()}


def time_beside(yardstick: ModuleType, num: int, width: int, height: int, repeats: int) -> None:
    """Print ratios of the times, then how far pictures and gradients are apart."""
    cotangents = np.random.default_rng(1).normal(size=(height, width, 5)).astype(np.float32)
    both = Beside(yardstick, num, width, height, cotangents)
    laps = defaultdict(list)
    for turn in range(common.WARM_UP + repeats):
        for who, steps in both.steps().items():
            taken = common.lap(steps)
            if turn >= common.WARM_UP:
                for name, milliseconds in (taken | {"forward + backward": sum(taken.values())}).items():
                    laps[who, name].append(milliseconds)
    print(f"{num} Gaussians, {width}x{height}, {common.threads()}, median of {repeats}")
    for name in ("forward", "backward", "forward + backward"):
        mine, yours = statistics.median(laps["ours", name]), statistics.median(laps["theirs", name])
        print(f"  {name:19s} ours {mine:6.2f} ms  theirs {yours:6.2f} ms  ratio {mine / yours:.3f}")

    gap = np.abs(np.moveaxis(both.picture[:3], 0, -1) - both.ours.color).max(-1)
    apart = np.mean(gap > 1e-4)
    print(f"  largest difference in color {gap.max():.1e}; {apart:.2%} of pixels differ by more than 1e-4")
    # Ours stops a pixel before the Gaussian that would fill it; theirs goes on until its whole tile is full.
    full = both.transmittance < STOP_TRANSMITTANCE
    print(f"  early stopping differs in {full.mean():.2%} of pixels; |ours - theirs| / |theirs| of the gradients:")
    everywhere = both.gradients(cotangents)
    elsewhere = both.gradients(np.where(full[..., None], np.float32(0), cotangents))
    for name, (mine, yours) in everywhere.items():
        without = relative_difference(*elsewhere[name])
        print(f"  {name:13s} {relative_difference(mine, yours):.1e} in all, {without:.1e} with cotangents 0 there")


def relative_difference(ours: NDArray, theirs: NDArray) -> float:
    """|ours - theirs| / |theirs|, over all Gaussians."""
    return float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs))


def near_to_far_rank(starts: NDArray, ids: NDArray, num: int) -> NDArray[np.float32]:
    """(N,) > 0 that sorts the Gaussians of every tile as its list does.

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
    """Command line: the stage like the others, or beside a yardstick."""
    parser = common.arguments(__doc__)
    parser.add_argument("--yardstick", type=Path, help="another compositing module")
    parser.add_argument("--gaussians", type=int, default=25_000, help="beside the yardstick")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 512), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--repeats", type=int, default=25)
    options = parser.parse_args()
    common.set_threads(options.threads)
    if options.yardstick is None:
        common.report(measure(common.sizes(options)), options)
        return
    spec = importlib.util.spec_from_file_location("yardstick", options.yardstick)
    yardstick = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(yardstick)
    time_beside(yardstick, options.gaussians, *options.size, options.repeats)


if __name__ == "__main__":
    main()
