"""Figures: plots of scores, and images side by side (frames with zooms, sides, depth instability, prior and density).

`H, W` image size. Images show the first seed and fold at the last budget.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from cv2.typing import MatLike
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from endoprior.core.config import DataConfig
from endoprior.core.geometry import length_unit, project
from endoprior.core.types import Camera, Frame, RenderedView, to_uint8
from endoprior.data import FrameSequence, load_sequence
from endoprior.evaluation.registry import all_scores
from endoprior.model.scene import RenderedScene, Scene
from endoprior.model.scene_file import load_scene
from endoprior.priors import joint_texture_prior, specular_likelihood
from endoprior.system.atomic import whole_file
from endoprior.visualization.image_tools import colorize, label, tile, write_png
from endoprior.visualization.rendered_views import tissue_distance, turned

from .matrix import Matrix, frames_of
from .results import Results
from .spec import Cell

FLOW_SCORES = ("flow_error", "flow_error_raft_small", "flow_error_dis")
"""The figure shows the first of these that all methods have."""
CURVE_SCORE = "psnr_tissue"
ZOOM = 4
"""A zoom window is this fraction of the frame's width and height."""
DENSITY_SIGMA = 64
"""The density of centers is blurred by this fraction of the frame's width."""
SIDES_DEG = (-15.0, 0.0, 15.0)
"""From where `sides_grid` looks; 0 is the endoscope, more is to its right."""
TILE_WIDTH_PX = 480
"""Narrower images are enlarged, so that their labels can be read."""
INSTABILITY_FULL_SCALE_MM = 1.0
DIFFERENCE_FULL_SCALE_MM = 0.5


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


def scenes_of(matrix: Matrix, sequence: str) -> dict[str, RenderedScene]:
    """The trained scene of every method that has one and whose cell is finished, by label."""
    spec = matrix.spec
    budget = spec.budgets[-1] if spec.budgets else None
    fold = spec.sequences[sequence].folds[0]
    folders = {m: matrix.done.get(Cell(sequence, m, budget, spec.seeds[0], fold)) for m in spec.methods}
    runs = {m: folder / "run" for m, folder in folders.items() if folder}
    return {spec.label(m): load_scene(run) for m, run in runs.items() if (run / "scene.safetensors").exists()}


def _camera(scene: RenderedScene, frame: Frame) -> Camera:
    """The camera of a frame, where the scene has it: its poses may have been estimated."""
    return replace(frame.camera, world_to_camera=scene.cameras[frame.index].world_to_camera)


def _rendered(scene: RenderedScene, frame: Frame) -> RenderedView:
    return scene.render(frame.time, _camera(scene, frame))


def frames_grid(sequence: FrameSequence, scenes: dict[str, RenderedScene]) -> NDArray[np.uint8]:
    """The middle test frame, zoomed to a highlight, a dark part and a mask border; columns: input and each method."""
    test = sequence.frames("test")
    frame = test[len(test) // 2]
    windows = zoom_windows(frame)
    columns = {"input": frame.rgb_u8}
    columns |= {name: to_uint8(_rendered(scene, frame).color.numpy()) for name, scene in scenes.items()}
    height, width = frame.tissue_mask.shape
    tiles = [_labeled(_outlined(image, windows), name) for name, image in columns.items()]
    for what, (rows, cols) in windows.items():
        for image in columns.values():
            zoomed = cv2.resize(image[rows, cols], (width, height), interpolation=cv2.INTER_NEAREST)
            tiles.append(_labeled(zoomed, what))
    return tile(tiles, len(columns))


def sides_grid(sequence: FrameSequence, scenes: dict[str, RenderedScene]) -> NDArray[np.uint8]:
    """The middle test frame, turned about the tissue; a row for each angle, a column for each method."""
    test = sequence.frames("test")
    frame, tiles = test[len(test) // 2], []
    distance = tissue_distance(frame, float(_rendered(next(iter(scenes.values())), frame).depth.median()))
    for degrees in SIDES_DEG:
        where = f"{abs(degrees):.0f} deg {'right' if degrees > 0 else 'left'}" if degrees else "endoscope"
        for name, scene in scenes.items():
            out = scene.render(frame.time, turned(_camera(scene, frame), degrees, distance))
            tiles.append(_labeled(to_uint8(out.color.numpy()), f"{name}, {where}"))
    return tile(tiles, len(scenes))


def zoom_windows(frame: Frame) -> dict[str, tuple[slice, slice]]:
    """The windows with the most highlights, the darkest tissue and the most border of the tissue mask."""
    height, width = frame.tissue_mask.shape
    size = (max(width // ZOOM, 1), max(height // ZOOM, 1))
    tissue = frame.tissue_mask.astype(np.float32)
    edge = cv2.morphologyEx(frame.tissue_mask.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    wanted = {
        "highlight": specular_likelihood(frame.rgb) * tissue,
        "dark": (1 - frame.rgb.max(-1)) * tissue,
        "boundary": edge.astype(np.float32),
    }
    windows = {}
    for name, values in wanted.items():
        # The mean of every window, stored at the window's upper left corner.
        means = cv2.boxFilter(values, cv2.CV_32F, size, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
        inside = means[: height - size[1] + 1, : width - size[0] + 1]
        top, left = np.unravel_index(int(inside.argmax()), inside.shape)
        windows[name] = (slice(int(top), int(top) + size[1]), slice(int(left), int(left) + size[0]))
    return windows


def _outlined(image: NDArray[np.uint8], windows: dict[str, tuple[slice, slice]]) -> NDArray[np.uint8]:
    outlined = np.ascontiguousarray(image).copy()
    for rows, cols in windows.values():
        cv2.rectangle(outlined, (cols.start, rows.start), (cols.stop - 1, rows.stop - 1), (255, 255, 255), 1)
    return outlined


def instability_grid(sequence: FrameSequence, scenes: dict[str, RenderedScene]) -> NDArray[np.uint8]:
    """Mean absolute change of rendered depth between adjacent frames, and each method's minus the first's."""
    frames, unit = list(sequence.frames("video")), length_unit(sequence.depth_is_relative)
    maps = {name: instability_map(scene, frames) for name, scene in scenes.items()}
    first = next(iter(maps))
    top = [
        _labeled(colorize(values, 0, INSTABILITY_FULL_SCALE_MM, np.isfinite(values)), f"{name}, 0..1 {unit}")
        for name, values in maps.items()
    ]
    bottom = []
    for values in maps.values():
        change = values - maps[first]
        shown = colorize(change, -DIFFERENCE_FULL_SCALE_MM, DIFFERENCE_FULL_SCALE_MM, np.isfinite(change))
        bottom.append(_labeled(shown, f"minus {first}, -0.5..0.5 {unit}"))
    return tile(top + bottom, len(maps))


def instability_map(scene: RenderedScene, frames: list[Frame]) -> NDArray[np.float64]:
    """(H, W) mean |change of depth|, mm, over adjacent pairs that both show rendered tissue; NaN where none does."""
    total = np.zeros(frames[0].tissue_mask.shape)
    count = np.zeros_like(total)
    depths = (_rendered(scene, frame).depth.numpy() for frame in frames)
    for (a, depth_a), (b, depth_b) in pairwise(zip(frames, depths, strict=True)):
        both = a.tissue_mask & b.tissue_mask & (depth_a > 0) & (depth_b > 0)
        total += np.where(both, np.abs(depth_b - depth_a), 0)
        count += both
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def prior_grid(sequence: FrameSequence, scenes: dict[str, RenderedScene]) -> NDArray[np.uint8]:
    """The joint texture prior of the first frame, and the density of each method's projected centers there."""
    frame = sequence.frame(0)
    rho = joint_texture_prior(frame.rgb, frame.tissue_mask)
    densities = {name: center_density(scene, frame) for name, scene in scenes.items() if isinstance(scene, Scene)}
    top = max((float(np.percentile(density, 99.5)) for density in densities.values()), default=0.0)
    tiles = [_labeled(frame.rgb_u8, "input"), _labeled(colorize(rho, 0, 1), "prior")]
    tiles += [_labeled(colorize(d, 0, top), f"centers, {name}") for name, d in densities.items()]
    return tile(tiles, len(tiles))


def center_density(scene: Scene, frame: Frame) -> NDArray[np.float32]:
    """(H, W) projected centers per pixel at the frame's time, blurred."""
    height, width = frame.tissue_mask.shape
    pixels, z = project(scene.at(frame.time).means.numpy().astype(np.float64), _camera(scene, frame))
    seen = (z > 0) & ((pixels >= 0) & (pixels < (width, height))).all(-1)
    column, row = pixels[seen].astype(int).T
    counts = np.zeros((height, width), np.float32)
    np.add.at(counts, (row, column), 1)
    return np.asarray(cv2.GaussianBlur(counts, (0, 0), max(width / DENSITY_SIGMA, 1)), np.float32)


def _labeled(image: MatLike, text: str) -> NDArray[np.uint8]:
    factor = -(-TILE_WIDTH_PX // image.shape[1])
    large = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    return label(np.asarray(large, np.uint8), text)


GRIDS: dict[str, Callable[[FrameSequence, dict[str, RenderedScene]], NDArray[np.uint8]]] = {
    "frames": frames_grid,
    "sides": sides_grid,
    "instability": instability_grid,
    "prior": prior_grid,
}
"""What makes each kind of figure."""


def write_image_grids(matrix: Matrix, folder: Path, kinds: set[str]) -> None:
    """Write those of `kinds` that are in `GRIDS` for every sequence into `folder`."""
    for name, data in matrix.data.items():
        scenes = scenes_of(matrix, name)
        if not scenes:
            continue
        spec = matrix.spec.sequences[name]
        sequence = load_sequence(data, DataConfig(**spec.reading_of(spec.folds[0])))
        for kind, make in GRIDS.items():
            if kind in kinds:
                write_png(folder / f"{kind}-{name}.png", make(sequence, scenes))
