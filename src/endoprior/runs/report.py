"""One image that summarizes a run: test frames beside their renders, curves, and the scores."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..core.geometry import length_unit
from ..core.types import to_uint8
from ..data import FrameSequence
from ..evaluation.context import read_frame_scores, read_scores
from ..evaluation.registry import all_scores
from ..model.scene import Scene
from ..priors import joint_texture_prior
from ..visualization.image_tools import colorize, save_figure
from ..visualization.rendered_views import depth_span, tissue_distance, turned
from ..visualization.tissue_layers import PaintedTissue, SupportMap
from .folder import LOG
from .log import iterations_done, read_log

SHOWN_SCORES = (
    "psnr_tissue psnr ssim depth_rmse_mm flow_error_dis color_share depth_instability_mm side_psnr right_psnr "
    "psnr_behind_tool psnr_behind_tool_seen depth_rmse_behind_tool_mm track_error_mm num_gaussians fps fps_cached "
    "train_seconds"
).split()
TURNS_DEG = (-20, -12, 12, 20)  # cameras beside the endoscope's, degrees; above 0 to its right
ERROR_FULL_SCALE = 0.15  # color error, in [0, 1], at the end of the error map's color scale


def write_report(scene: Scene, sequence: FrameSequence, run: Path, path: Path, title: str = "") -> None:
    """Write the report of a finished run folder as one PNG.

    Rows: three test frames as columns of input, rendering, true tissue if known, error, depth and prior; the second of
    them from cameras to both sides, and with all that no frame saw hatched; a grid painted on the first frame and
    carried on, beside the input; then the training curve, the PSNR of each test frame, and the scores.
    """
    sequence = sequence.with_poses(scene.cameras)
    scores, per_frame = read_scores(run / "metrics.json")["scores"], read_frame_scores(run / "per_frame.json")
    log = read_log(run / LOG, "stage", "iteration", "terms")
    rows = [*_image_rows(scene, sequence), _side_row(scene, sequence), _texture_row(scene, sequence)]
    # An own canvas: `pyplot` would choose a backend for the whole process.
    figure = Figure(figsize=(2.6 * len(rows[0]), 2.1 * len(rows) + 3.4), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=12)
    (top,), (bottom,) = figure.subfigures(2, 1, squeeze=False, height_ratios=[2.1 * len(rows), 3.4])
    for row, cells in zip(top.subplots(len(rows), len(rows[0])), rows, strict=True):
        for axis in row:
            axis.set_axis_off()
        for axis, (title, image) in zip(row, cells, strict=False):  # rows below the frames are shorter
            axis.imshow(image)
            axis.set_title(title, fontsize=8)
    loss_axis, psnr_axis, table_axis = bottom.subplots(1, 3, width_ratios=[1, 1, 1.1])
    plot_loss(loss_axis, log)
    _plot_psnr(psnr_axis, per_frame)
    _write_scores(table_axis, scores, sequence.depth_is_relative)
    save_figure(figure, path)


def _image_rows(scene: Scene, sequence: FrameSequence) -> list[list[tuple[str, NDArray[np.uint8]]]]:
    frames = sequence.frames("test")
    shown = sorted({int(k) for k in np.linspace(0, len(frames) - 1, 3)})
    span, unit = depth_span(scene), length_unit(sequence.depth_is_relative)
    rows = []
    for frame in (frames[k] for k in shown):
        out = scene.render_with_smoke(frame.time, frame.camera)
        color, depth = out.color.cpu().numpy(), out.depth.cpu().numpy()
        error = np.abs(color - frame.rgb).mean(-1)
        cells = [(f"input, frame {frame.index} (test)", frame.rgb_u8), ("rendered", to_uint8(color))]
        tissue = sequence.truth.tissue(frame.index) if sequence.truth else None
        if tissue is not None:
            cells.append(("true tissue", tissue))
        rho = joint_texture_prior(frame.rgb, frame.tissue_mask)
        cells += [
            (f"error on tissue, 0..{ERROR_FULL_SCALE}", colorize(error, 0, ERROR_FULL_SCALE, frame.tissue_mask)),
            (f"depth, {span[0]:.0f}..{span[1]:.0f} {unit}", colorize(depth, *span, depth > 0)),
            ("joint texture prior", colorize(rho, 0, 1)),
        ]
        rows.append(cells)
    return rows


def _side_row(scene: Scene, sequence: FrameSequence) -> list[tuple[str, NDArray[np.uint8]]]:
    frames = sequence.frames("test")
    frame = frames[(len(frames) - 1) // 2]
    distance = tissue_distance(frame, float(np.mean(depth_span(scene))))
    cells = []
    for degrees in TURNS_DEG:
        out = scene.render(frame.time, turned(frame.camera, degrees, distance))
        side = "right" if degrees > 0 else "left"
        cells.append((f"frame {frame.index} from {abs(degrees)} degrees {side}", to_uint8(out.color.cpu().numpy())))
    marked = SupportMap(scene, sequence.training_part).render(frame.time, frame.camera)
    return [*cells, (marked.legend, to_uint8(marked.color))]


def _texture_row(scene: Scene, sequence: FrameSequence) -> list[tuple[str, NDArray[np.uint8]]]:
    painted, cells = PaintedTissue(scene), []
    for index in (0, len(sequence) // 2, len(sequence) - 1):
        frame = sequence.frame(index)
        color = to_uint8(painted.render(frame.time, frame.camera))
        if index:
            cells.append((f"input, frame {index}", frame.rgb_u8))
        cells.append((f"grid carried to frame {index}" if index else "grid on frame 0", color))
    return cells


def plot_loss(axis: Axes, log: Sequence[dict[str, Any]]) -> None:
    """The objective over all iterations of a log, and where the fine stage of a window begins."""
    iterations = iterations_done(log)
    axis.semilogy(iterations, [sum(line["terms"].values()) for line in log], linewidth=0.6, color="tab:red")
    stages = pairwise(zip(iterations, (line["stage"] for line in log), strict=True))
    starts = [done for (done, before), (_, after) in stages if (before, after) == ("coarse", "fine")]
    for k, start in enumerate(starts):
        axis.axvline(start, color="gray", linestyle=":", label="" if k else "fine stage begins")
    axis.set_title("training objective", fontsize=9)
    axis.set_xlabel("iteration", fontsize=8)
    if starts:
        axis.legend(fontsize=7)


def _plot_psnr(axis: Axes, per_frame: Sequence[dict[str, float]]) -> None:
    points = [(row["index"], row["psnr_tissue"]) for row in per_frame if "psnr_tissue" in row]
    if points:
        axis.plot(*zip(*points, strict=True), "o-", color="tab:blue", markersize=4)
    axis.set_title(f"{all_scores()['psnr_tissue'].heading()}, test frames", fontsize=9)
    axis.set_xlabel("frame", fontsize=8)
    axis.grid(alpha=0.3)


def _write_scores(axis: Axes, scores: dict[str, float], relative: bool) -> None:
    shown = [(all_scores()[name], scores[name]) for name in SHOWN_SCORES if name in scores]
    lines = [f"{score.label:<22}{score.text(value, relative):>14}" for score, value in shown]
    axis.text(0, 1, "\n".join(lines), family="monospace", fontsize=8, va="top", transform=axis.transAxes)
    axis.set_axis_off()
