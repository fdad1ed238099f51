"""The figure of `endoprior check`: frames with tools and borders, depth, curves over time, initial points."""

from __future__ import annotations

import os
import textwrap
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from ..core.geometry import length_unit, project
from ..core.ranges import evenly_spaced
from ..core.types import Frame
from ..data import FrameSequence
from ..footage.depth_unit import FAR_MM, NEAR_MM
from ..footage.overlays import find_strokes
from ..visualization.image_tools import colorize, save_figure
from .facts import Facts
from .findings import SEEN_AS_TISSUE, Finding
from .report import table, unit_reason

SHOWN = 4  # Number of frames shown
MAX_UNSURE = 6  # Largest number of frames shown whose masks are uncertain
UNSURE_HEIGHT = 2.2  # Of their row in the figure, inches
RULER_MM = 10.0  # Length of the ruler, at the median depth of the frame
TOOL_COLOR, BORDER_COLOR, FLAG_COLOR = "#ff3b30", "#ffd60a", "#d62728"
WRAPPED_AT, ROWS = 84, 34  # Characters per line and number of lines of the findings panel
LABEL_WIDTH = 70  # Characters per line below the histogram
SEVERITY_COLOR = {"error": "#b00020", "warning": "#b26a00", "note": "#3a5a78"}


def draw_check(sequence: FrameSequence, facts: Facts, findings: list[Finding], path: Path) -> None:
    """Write the figure of a measured sequence as a PNG file, completely or not at all.

    Rows: frames with tools outlined in red and borders in yellow; their depth; depth histogram and curves over time,
    with the frames of findings marked; initial points from the camera and from the side, and the findings; the frames
    whose masks are doubtful, if any are.
    """
    # Use a canvas directly: selecting a Matplotlib backend would change the whole process.
    confidence = facts.masks.confidence
    like = facts.masks.tissue_like
    unsure = sorted(facts.masks.uncertain, key=lambda i: (confidence[i], i))[: MAX_UNSURE - (like is not None)]
    figure = Figure(figsize=(15, 14 + UNSURE_HEIGHT * bool(unsure or like)), layout="constrained", dpi=100)
    FigureCanvasAgg(figure)
    camera = facts.camera
    # A file name may hold bytes that are not text, and characters that Matplotlib would parse as formulas.
    name = os.fsencode(facts.path.name).decode("utf-8", "backslashreplace")
    title = f"{name}   {facts.frames} frames of {camera.width} x {camera.height} px"
    figure.suptitle(title, fontsize=13, parse_math=False)
    heights = [5.6, 3.4, 4.8, *([UNSURE_HEIGHT] if unsure or like else [])]
    images, curves, space, *rest = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights).flat
    _draw_frames(images, [sequence.frame(i) for i in evenly_spaced(len(sequence), SHOWN)], facts)
    left, right = curves.subfigures(1, 2, squeeze=False, width_ratios=[1, 2.4]).flat
    _draw_histogram(left.subplots(), facts)
    _draw_curves(right, facts, findings)
    axes = space.subplots(1, 3, width_ratios=[1, 1.15, 1.45])
    _draw_cloud(axes[0], axes[1], facts)
    _draw_findings(axes[2], facts, findings)
    if unsure or like:
        shown = [*([like.frame] if like else []), *unsure]
        _draw_doubtful(rest[0], [sequence.frame(i) for i in shown], facts)
    save_figure(figure, path)


def _draw_frames(part: SubFigure, frames: list[Frame], facts: Facts) -> None:
    axes = np.atleast_2d(part.subplots(2, len(frames), squeeze=False))
    low, high = facts.depth.low, facts.depth.high
    for column, frame in enumerate(frames):
        top, bottom = axes[:, column]
        top.imshow(_outlined(frame, facts.border.masked))
        top.set_title(f"frame {frame.index}: {facts.masks.tool_fraction[frame.index]:.0%} tool", fontsize=9)
        _draw_border(top, facts)
        if not facts.depth.relative:
            _draw_ruler(top, frame)
        bottom.imshow(colorize(frame.depth, low, high, frame.depth_valid))
        bottom.set_title("depth, black where missing", fontsize=9)
        for axis in (top, bottom):
            axis.set_xlim(0, frame.camera.width)
            axis.set_ylim(frame.camera.height, 0)
            axis.set_axis_off()
    if high <= 0:
        return
    scale = ScalarMappable(Normalize(low, max(high, 1.0001 * low)), "turbo")
    place = {"location": "right", "fraction": 0.02, "pad": 0.01, "aspect": 45}
    bar = part.colorbar(scale, ax=axes.ravel().tolist(), **place)
    bar.set_label(f"depth, {length_unit(facts.depth.relative)}", fontsize=8)
    bar.ax.tick_params(labelsize=8)


def _draw_doubtful(part: SubFigure, frames: list[Frame], facts: Facts) -> None:
    """Frames with their masks outlined: one with what moves like tissue, if anything does, then the least certain."""
    axes, like = part.subplots(1, MAX_UNSURE, squeeze=False)[0], facts.masks.tissue_like
    for axis in axes:
        axis.set_axis_off()
    for place, (axis, frame) in enumerate(zip(axes, frames, strict=False)):  # fewer frames leave places empty
        axis.imshow(_outlined(frame, facts.border.masked))
        what = f"unsure, {facts.masks.confidence[frame.index]:.2f}"
        if like and place == 0:
            axis.plot(like.x, like.y, marker="x", markersize=12, markeredgewidth=2.5, color=FLAG_COLOR)
            what = "x moves with the tissue"
        axis.set_title(f"frame {frame.index}: {what}", fontsize=9)


def _outlined(frame: Frame, border: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The frame with tools tinted and outlined in red, and masked drawings (boxes, text) in yellow; a masked border
    (H, W) is no tool.
    """
    image = frame.rgb_u8.copy()
    drawn = ~frame.tissue_mask & find_strokes(image)
    tool = ~frame.tissue_mask & ~border & ~drawn
    red, yellow = (
        np.array([int(of[i : i + 2], 16) for i in (1, 3, 5)], np.float32) for of in (TOOL_COLOR, BORDER_COLOR)
    )
    image[drawn] = yellow
    image[tool] = (0.72 * image[tool] + 0.28 * red).astype(np.uint8)
    outlines, _ = cv2.findContours(tool.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, outlines, -1, red.tolist(), max(1, image.shape[1] // 300))
    return image


def _draw_border(axis: Axes, facts: Facts) -> None:
    """Strips, border and labels, in yellow; dotted where the masks already exclude them."""
    border, strips, width, height = facts.border, facts.border.strips, facts.camera.width, facts.camera.height
    sides = (
        (0, 0, width, strips.top),
        (0, height - strips.bottom, width, strips.bottom),
        (0, 0, strips.left, height),
        (width - strips.right, 0, strips.right, height),
    )
    open_strips, open_outside = (s > SEEN_AS_TISSUE for s in (border.strips_as_tissue, border.outside_as_tissue))
    patches: list[tuple[Patch, bool]] = [
        (Rectangle((x, y), across, down, hatch="//"), open_strips) for x, y, across, down in sides if across and down
    ]
    if border.outside.any():
        style = "solid" if open_outside else "dotted"
        edges = {"colors": BORDER_COLOR, "linewidths": 1.2, "linestyles": style}
        axis.contour(np.arange(width) + 0.5, np.arange(height) + 0.5, border.outside, [0.5], **edges)
    patches += [(Rectangle((x, y), across, down), True) for x, y, across, down in border.overlays]
    for patch, is_open in patches:
        patch.set(fill=False, edgecolor=BORDER_COLOR, linewidth=1.2, linestyle="-" if is_open else ":")
        axis.add_patch(patch)


def _draw_ruler(axis: Axes, frame: Frame) -> None:
    """A line of 10 mm at the median depth of the frame. With a wrong depth unit its length is implausible."""
    if not frame.depth_valid.any():
        return
    length = RULER_MM * frame.camera.fx / float(np.median(frame.depth[frame.depth_valid]))
    width, height = frame.camera.width, frame.camera.height
    left, y = 0.04 * width, 0.94 * height
    axis.plot([left, left + min(length, 2 * width)], [y, y], color="white", linewidth=3, solid_capstyle="butt")
    axis.text(left, y - 0.02 * height, f"{RULER_MM:g} mm", color="white", fontsize=8, va="bottom")


def _draw_histogram(axis: Axes, facts: Facts) -> None:
    depth = facts.depth
    axis.stairs(depth.counts / max(depth.counts.sum(), 1), depth.edges, fill=True, color="#4a7fb5")
    low, high = depth.edges[0], depth.edges[-1]
    title, usual = "depth of tissue", (max(low, NEAR_MM), min(high, FAR_MM))
    if not depth.relative:
        title += f", green: {NEAR_MM:g}-{FAR_MM:g} mm is usual"
        if usual[0] < usual[1]:
            axis.axvspan(*usual, color="#2e8b57", alpha=0.10, zorder=0)
    axis.set_xlim(low, high)
    axis.set_title(title, fontsize=9)
    axis.set_xlabel(textwrap.fill(f"{length_unit(depth.relative)}   ({unit_reason(facts)})", LABEL_WIDTH), fontsize=8)
    axis.set_yticks([])
    axis.tick_params(labelsize=8)


def _draw_curves(part: SubFigure, facts: Facts, findings: list[Finding]) -> None:
    """Four curves over the frames, each with the frames of its findings marked."""
    moved = np.arange(1, len(facts.motion.pixels_per_frame) + 1) * facts.motion_step
    every, unit = np.arange(facts.frames), length_unit(facts.depth.relative)
    curves = (
        ("brightness", every, facts.changes.brightness, {"exposure-jump", "unexplained-frames", "scene-cut"}),
        ("tool, share of pixels inside the border", every, facts.masks.tool_fraction, set()),
        (f"median depth, {unit}", every, facts.depth.median, {"depth-jumps", "no-depth-frames"}),
        ("image motion, px per frame", moved, facts.motion.pixels_per_frame, {"duplicate-frames"}),
    )
    for axis, (title, x, y, codes) in zip(part.subplots(2, 2, sharex=True).flat, curves, strict=True):
        axis.plot(x, y, color="#30506b", linewidth=1.2)
        for frame in sorted({frame for finding in findings if finding.code in codes for frame in finding.frames}):
            axis.axvline(frame, color=FLAG_COLOR, linewidth=0.8, alpha=0.7)
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.25)
        axis.set_xlim(0, max(facts.frames - 1, 1))
        top = float(np.nanmax(y)) if np.isfinite(y).any() else 1.0
        axis.set_ylim(0, 1.15 * top or 1.0)


def _draw_cloud(front: Axes, side: Axes, facts: Facts) -> None:
    """The initial points, from the first camera and from the side with the camera at the left edge."""
    # Above, not below the axes: they keep their aspect, so that the layout would not leave room for a label there.
    distance = f"from the side; distance from the camera, {length_unit(facts.depth.relative)}"
    for axis, title in ((front, "initial points, from the camera"), (side, distance)):
        axis.set_facecolor("#101418")
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=8)
    if facts.cloud is None:
        for axis in (front, side):
            axis.text(0.5, 0.5, "no points", color="white", ha="center", transform=axis.transAxes)
            axis.set(xticks=[], yticks=[])
        return
    camera = facts.camera
    points, colors = facts.cloud.points.astype(np.float64), facts.cloud.colors
    pixels, z = project(points, camera)
    in_camera = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    far_first = np.argsort(-z)
    front.scatter(*pixels[far_first].T, s=4, c=colors[far_first], linewidths=0)
    front.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal", xticks=[], yticks=[])
    left_first = np.argsort(in_camera[:, 0])
    side.scatter(z[left_first], in_camera[left_first, 1], s=2.5, c=colors[left_first], linewidths=0)
    reach = float(np.percentile(z, 99.5)) * 1.08
    half = camera.height / camera.fy / 2
    offset = (camera.height / 2 - camera.cy) / camera.fy
    for edge in (offset - half, offset + half):
        side.plot([0, reach], [0, edge * reach], color="#8899aa", linewidth=0.7, linestyle=":")
    side.set(xlim=(0, reach), ylim=((offset + half) * reach, (offset - half) * reach), aspect="equal")


def _draw_findings(axis: Axes, facts: Facts, findings: list[Finding]) -> None:
    """The findings without their fixes, which are long, and below them as much of the table of facts as fits."""
    axis.set_axis_off()
    lines: list[tuple[str, str, str]] = []
    for finding in findings:
        lines.append((f"{finding.severity}: {finding.code}", SEVERITY_COLOR[finding.severity], "bold"))
        lines += [(line, "black", "normal") for line in [*textwrap.wrap(finding.what, WRAPPED_AT), ""]]
    if not findings:
        lines += [("no problems", "#2e8b57", "bold"), ("", "black", "normal")]
    told = table(facts)
    column = max(len(name) for name, _ in told) + 1
    for name, value in told:
        rows = textwrap.wrap(value, WRAPPED_AT - column) or [""]
        lines += [(f"{name if i == 0 else '':<{column}}{row}", "#3a5a78", "normal") for i, row in enumerate(rows)]
    for row, (text, color, weight) in enumerate(lines[:ROWS]):
        at = {"x": 0, "y": 1 - row / ROWS, "va": "top", "transform": axis.transAxes}
        axis.text(**at, s=text, parse_math=False, color=color, weight=weight, fontsize=7.5, family="monospace")
