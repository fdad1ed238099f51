"""Do the ranges of carried points hold as many true values as they say? Fits them to phantoms, leaving kinds out.

    python bench/uncertainty.py DATA RUN [DATA RUN ...]     coverage with the numbers of the program
    python bench/uncertainty.py --fit DATA RUN [...]        new numbers, and their coverage on kinds left out
    python bench/uncertainty.py --flow DATA RUN [...]       of real clips: against optical flow, in the image

Flow is chained from frame to frame (DIS), held-out frames included; only points that return in every step so far, to
within a pixel, count. It has errors of its own, which count as the model's here.

DATA are folders of `endoprior phantom`, named by kind and number (`pull2`: kind `pull`); RUN is a training of it.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import common  # noqa: F401, before torch
import numpy as np
import torch
from numpy.typing import NDArray

from endoprior.core.geometry import back_project, camera_to_world, project
from endoprior.data import load_sequence
from endoprior.evaluation.scorers.tracks import chained_flow
from endoprior.evaluation.scoring import scored_data
from endoprior.model import uncertainty
from endoprior.model.carry import carry
from endoprior.model.scene_file import load_scene
from endoprior.model.surface import render_surface, surface_points
from endoprior.model.uncertainty import Across, Along, Sources

LEVELS = 0.5, 0.8, 0.95
SAMPLES = 4000
"""Errors of each kind, in each place, of a clip that the fit sees."""


@dataclass(frozen=True)
class Errors:
    """True errors of the carried points of one clip, and what they are told from; flat arrays."""

    kind: str
    name: str
    of: Sources
    across_px: NDArray[np.float64]  # distance in the image, px of an image 640 px wide
    start_mm: NDArray[np.float64]  # along the ray where the point was picked
    drift_mm: NDArray[np.float64]  # along the ray since then
    visible: NDArray[np.bool_]

    def error(self, what: str) -> NDArray[np.float64]:
        """Absolute errors of one kind."""
        return np.abs({"across": self.across_px, "start": self.start_mm, "drift": self.drift_mm}[what])


def errors_of(data: Path, run: Path) -> Errors:
    """Points that the first, the middle and the last frame show, picked there on the rendered surface."""
    scene = load_scene(run)
    sequence = load_sequence(data, scored_data(scene.config.data))
    tracks, total = sequence.truth.tracks, len(sequence)
    to_world = camera_to_world(sequence.camera(i) for i in range(total))
    frames, parts = np.arange(total), []
    for first in (0, total // 2 + 1, total - 1):
        camera = sequence.camera(first)
        shown = np.flatnonzero(tracks.visible[first])
        pixels = project(tracks.points[first, shown].astype(float), replace(camera, world_to_camera=np.eye(4)))[0]
        starts = surface_points(scene, pixels, np.full(len(pixels), first, np.intp))
        known = np.isfinite(starts).all(1)
        shown, start, own = shown[known], starts[known], np.full(known.sum(), first, np.intp)
        carried = carry(scene, start, own, (frames / total).tolist())
        of = uncertainty.sources_of(scene, carried, own, range(total))
        true = np.einsum("tij,tpj->tpi", to_world[:, :3, :3], tracks.points[:, shown].astype(float))
        true += to_world[:, None, :3, 3]
        error = carried.positions - true
        along = (error * of.rays).sum(-1)
        across = np.linalg.norm(error - along[..., None] * of.rays, axis=-1) / of.mm_per_px
        columns = [np.broadcast_to(each, along.shape) for each in (*of[1:], across, along[first], along - along[first])]
        parts.append([each[of.is_later] for each in (*columns, tracks.visible[:, shown])])
    mm_per_px, place, later, spread, moved, noise, start_noise, across, start, drift, visible = map(
        np.concatenate, zip(*parts, strict=True)
    )
    of = Sources(np.zeros((0, 3)), mm_per_px, place, later, spread, moved, noise, start_noise)
    return Errors(data.name.rstrip("0123456789"), data.name, of, across, start, drift, visible)


def terms(of: Sources, what: str) -> NDArray[np.float64]:
    """(N, K) what the numbers of `Across` or `Along` multiply."""
    if what == "across":
        return np.stack([np.ones_like(of.spread_px), of.spread_px**2, of.moved_px**2], 1)
    if what == "start":
        return of.start_noise_mm[:, None] ** 2
    return np.stack([of.noise_mm**2, (of.spread_px * of.mm_per_px) ** 2], 1)


def fitted(samples: list[tuple[NDArray, NDArray]], axes: int) -> tuple[list[float], float]:
    """Shares of the variance and degrees of freedom that make the errors likeliest, each clip counting as much.

    Args: samples: terms (N, K) and errors (N,) of each clip. axes: 2 for distances, else 1.
    """
    data = [(torch.from_numpy(np.ascontiguousarray(x)), torch.from_numpy(np.ascontiguousarray(e))) for x, e in samples]
    shares = torch.full((samples[0][0].shape[1],), -3.0, dtype=torch.float64, requires_grad=True)
    freedom = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([shares, freedom], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        n, total = freedom.exp() + 0.5, torch.zeros((), dtype=torch.float64)
        for x, error in data:
            variance = x @ shares.exp() + 1e-8
            total = (
                total
                + (
                    torch.lgamma(n / 2)
                    - torch.lgamma((n + axes) / 2)
                    + axes / 2 * (torch.log(n) + torch.log(variance))
                    + (n + axes) / 2 * torch.log1p(error**2 / variance / n)
                ).mean()
            )
        total = total / len(data)
        total.backward()
        return total

    optimizer.step(loss)
    return shares.exp().tolist(), float(freedom.exp()) + 0.5


def radius(level: float, freedom: float, axes: int) -> float:
    """Within which a share `level` of t-distributed errors of scale 1 lies: of distances in a plane, or on a line."""
    if axes == 2:
        return math.sqrt(freedom * ((1 - level) ** (-2 / freedom) - 1))
    return float(uncertainty.student_t.ppf((1 + level) / 2, freedom))


Rows = dict[str, tuple[Across, ...] | tuple[Along, ...]]
"""The numbers by their names in the program."""


def samples_of(clips: list[Errors], what: str, place: int | None) -> list[tuple[NDArray, NDArray]]:
    """Terms and errors of some points of each clip."""
    rng, found = np.random.default_rng(0), []
    for clip in clips:
        rows = np.arange(len(clip.of.place)) if place is None else np.flatnonzero(clip.of.place == place)
        rows = rng.permutation(rows)[:SAMPLES]
        if len(rows) > 50:
            found.append((terms(clip.of, what)[rows], clip.error(what)[rows]))
    return found


def fit(clips: list[Errors]) -> Rows:
    """Every row of numbers."""
    places = (uncertainty.SEEN, uncertainty.NEAR, uncertainty.HIDDEN)
    across = [fitted(samples_of(clips, "across", place), 2) for place in places]
    drift = [fitted(samples_of(clips, "drift", place), 1) for place in places]
    (share,), freedom = fitted(samples_of(clips, "start", None), 1)
    rows: Rows = {
        "ACROSS": tuple(Across(*shares, freedom) for shares, freedom in across),
        "DRIFT": tuple(Along(*shares, freedom) for shares, freedom in drift),
        "START": (Along(share, 0.0, freedom),),
    }
    return {name: widened(clips, name, row) if name in WIDENED else row for name, row in rows.items()}


WIDENED = {"ACROSS": "across", "DRIFT": "drift"}


def widened(clips: list[Errors], name: str, rows: tuple[Any, ...]) -> tuple[Any, ...]:
    """The rows with the variance of points near and behind tools so large that the 95 % ranges of those that are truly
    hidden hold 95 % of them, mean of the clips: a place in a small mask tells only roughly what is hidden.
    """
    for factor in np.arange(1, 8, 0.1):
        wider = rows[0], *(type(row)(*(factor * share for share in row[:-1]), row.freedom) for row in rows[1:])
        held = [inside(clip, WIDENED[name], wider, LEVELS[-1])[~clip.visible].mean() for clip in clips]
        if np.mean(held) >= LEVELS[-1]:
            break
    return wider


def inside(clip: Errors, what: str, rows: tuple[Any, ...], level: float) -> NDArray[np.bool_]:
    """(N,) whether each error is inside of its range."""
    x, axes = terms(clip.of, what), 2 if what == "across" else 1
    scale = np.sqrt(np.choose(clip.of.place, [x @ np.array(row[: x.shape[1]]) for row in rows]))
    return clip.error(what) <= scale * np.array([radius(level, row.freedom, axes) for row in rows])[clip.of.place]


def coverage(clip: Errors, rows: Rows) -> list[str]:
    """Shares of errors inside of the 50, 80 and 95 % ranges: seen and hidden points, as the truth has it."""
    cells = []
    for what, numbers in (("across", rows["ACROSS"]), ("start", rows["START"] * 3), ("drift", rows["DRIFT"])):
        held = [inside(clip, what, numbers, level) for level in LEVELS]
        for where in (clip.visible, ~clip.visible):
            cells.append("{:.2f} {:.2f} {:.3f}".format(*(each[where].mean() for each in held)))
    return cells


def by_flow(data: Path, run: Path) -> list[str]:
    """Rows of a table: shares of positions by flow that are inside of the ranges across the ray."""
    scene = load_scene(run)
    sequence = load_sequence(data, scored_data(scene.config.data))
    camera, total = sequence.camera(0), len(sequence)
    surface, frame = render_surface(scene, 0.0, camera), sequence.frame(0)
    step = camera.width // 32
    x, y = (
        each.ravel()
        for each in np.meshgrid(*(np.arange(step, size - step, step) for size in (camera.width, camera.height)))
    )
    on = (surface.depth[y, x] > 0) & frame.tissue_mask[y, x]
    pixels = np.stack([x[on], y[on]], 1) + 0.5
    own = np.zeros(len(pixels), np.intp)
    starts = back_project(pixels, surface.depth[y[on], x[on]].astype(float), camera)
    carried = carry(scene, starts, own, [i / total for i in range(total)])
    errors = uncertainty.point_errors(scene, carried, own, range(total))
    in_camera = starts @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    flow = chained_flow(in_camera, own, sequence)
    followed = np.logical_and.accumulate(flow.visible[1:], axis=0)
    off, mm_per_px = np.empty((total, len(pixels), 2)), np.empty((total, len(pixels)))
    for i in range(total):
        there, z = project(carried.positions[i].astype(float), sequence.camera(i))
        off[i], mm_per_px[i] = there - flow.pixels[i], z / sequence.camera(i).fx
    rows = []
    for low, high in ((1, 10), (10, 30), (30, total)):
        where = followed[low - 1 : high - 1]
        if where.sum() < 50:
            continue
        shares = []
        for level in LEVELS:
            reach = (errors.across.half_width(level) / mm_per_px)[low:high]
            shares.append(f"{(np.abs(off[low:high]) <= reach[..., None])[where].mean():.3f}")
        rows.append(f"| {data.name} | {low} to {high - 1} | {where.sum()} | {', '.join(shares)} |")
    return rows


def main() -> None:
    """See the head of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--flow", action="store_true")
    args = parser.parse_args()
    if args.flow:
        print("| clip | frames since the pick | points | inside of 50, 80, 95 % |\n|---|---|---|---|")
        for data, run in zip(args.paths[::2], args.paths[1::2], strict=True):
            print(*by_flow(data, run), sep="\n", flush=True)
        return
    clips = [errors_of(data, run) for data, run in zip(args.paths[::2], args.paths[1::2], strict=True)]
    shipped: Rows = {"ACROSS": uncertainty.ACROSS, "DRIFT": uncertainty.DRIFT, "START": (uncertainty.START,)}
    if args.fit:
        for name, rows in fit(clips).items():
            print(name, "=", *(f"{type(row).__name__}({', '.join(f'{value:.3g}' for value in row)})," for row in rows))
    print("| clip | across: seen | hidden | start: seen | hidden | along, since then: seen | hidden |")
    print("|---|---|---|---|---|---|---|")
    for clip in clips:
        rows = fit([other for other in clips if other.kind != clip.kind]) if args.fit else shipped
        print(f"| {clip.name} | {' | '.join(coverage(clip, rows))} |", flush=True)


if __name__ == "__main__":
    main()
