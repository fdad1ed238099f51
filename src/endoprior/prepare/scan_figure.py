"""The timeline of a scan: pictures, segments and what is wrong between them, and the curves that tell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from ..core.ranges import evenly_spaced
from ..visualization.image_tools import save_figure
from .segments import WORDS, best_segment, from_json, segments_of
from .source import open_source

NUM_IMAGES = 8
GOOD, BEST = "#8fc98f", "#2e8b57"
COLORS: dict[str, str] = dict(
    zip(WORDS, ("#9e9e9e", "#c9a227", "#222222", "#f2d16b", "#4a78b5", "#b58ad1", "#d62728", "#e0c9c9"), strict=True)
)
CURVES = ("brightness", "contrast", "focus", "floor", "overexposed")


def draw_scan(
    video: Path,
    scanned: dict[str, Any],
    path: Path,
    folder_rate: float | None = None,
    pictures: Sequence[NDArray[np.uint8]] = (),
) -> None:
    """Write the timeline of a video as a PNG file, completely or not at all.

    Args:
        scanned: what `scan.json` holds. pictures: `Scan.pictures`; without them, they are read from the video.
    """
    stretches, whole, looks = from_json(scanned), scanned["seconds"], scanned["looks"]
    # Use a canvas directly: selecting a Matplotlib backend would change the whole process.
    figure = Figure(figsize=(15, 8), layout="constrained", dpi=100)
    FigureCanvasAgg(figure)
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=[1, 3]).flat
    pictures = pictures or open_source(video, folder_rate).sample_images(0.0, whole, NUM_IMAGES)
    for axis in np.atleast_1d(top.subplots(1, NUM_IMAGES)):
        axis.set_axis_off()
    for axis, i in zip(top.axes, evenly_spaced(len(pictures), NUM_IMAGES), strict=False):
        axis.imshow(pictures[i])
    bar, curves, motion = bottom.subplots(3, 1, sharex=True, height_ratios=[1, 2, 1.2])
    segments = segments_of(stretches)
    best = best_segment(segments) if segments else -1
    for stretch in stretches:
        is_best = best >= 0 and stretch is segments[best]
        color = COLORS[stretch.reason] if stretch.reason else BEST if is_best else GOOD
        bar.axvspan(stretch.start, stretch.end, color=color, linewidth=0)
        if not stretch.reason and stretch.seconds > 0.02 * whole:
            middle, number = (stretch.start + stretch.end) / 2, segments.index(stretch) + 1
            bar.text(middle, 0.5, str(number), ha="center", va="center", fontsize=9)
    for cut in scanned["cuts"]:
        bar.axvline(cut, color=COLORS["scene change"], linewidth=0.8)
    used = [word for word in WORDS if any(stretch.reason == word for stretch in stretches)]
    shown = [Patch(color=BEST, label="best segment"), Patch(color=GOOD, label="segments")]
    shown += [Patch(color=COLORS[word], label=word) for word in used]
    if scanned["cuts"] and "scene change" not in used:
        shown.append(Patch(color=COLORS["scene change"], label="scene change"))
    bar.legend(handles=shown, ncols=len(shown), loc="lower left", bbox_to_anchor=(0, 1), fontsize=8, frameon=False)
    bar.set_yticks([])
    for name in CURVES:
        values = np.array(looks[name], np.float64)
        scale = 1.0 if name in ("brightness", "overexposed") else max(float(np.percentile(values, 98)), 1e-6)
        curves.plot(
            looks["seconds"], values / scale, linewidth=0.9, label=name if scale == 1 else f"{name} (of its most)"
        )
    curves.set_ylim(0, 1.3)
    curves.legend(ncols=len(CURVES), loc="upper left", fontsize=8, frameon=False)
    shifts = 100 * np.array(looks["shift"], np.float64)
    motion.plot(looks["seconds"], shifts, ".", markersize=2)
    motion.set_ylim(0, 1.2 * float(np.nanpercentile(shifts, 99)) + 0.1 if np.isfinite(shifts).any() else 1.0)
    motion.set_ylabel("motion, % of width")
    motion.set_xlabel("s (no point: motion unknown)")
    motion.set_xlim(0, max(whole, 1e-3))
    save_figure(figure, path)
