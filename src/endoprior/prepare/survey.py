"""A first walk through a clip: how much there is, and what surrounds the picture. It decides the geometry."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..data.reading import complaint
from ..footage.border import Circle, Strips, find_circle, find_strips
from ..footage.text import find_static_overlays
from .calibration import Calibration
from .clip import Clip, Shot, Spread
from .config import PrepareConfig, Rectangle, parse_rectangle
from .view import View, make_view

SAMPLES = 24
"""Pictures that borders, labels, tools and light are judged by."""


@dataclass
class Survey:
    """What the first walk found."""

    indices: list[int]
    """In the source, of the pictures in the selection."""
    samples: list[Shot]
    """At most `SAMPLES` of them, evenly spread."""
    view: View
    remarks: list[str] = field(default_factory=list)
    """What the user should know, one line each."""


def look_through(clip: Clip, cfg: PrepareConfig, calibration: Calibration | None, name: str) -> Survey:
    """Walk through the selection once.

    Args:
        name: of the calibration file, for complaints.
    Raises:
        InputError: too few or too many pictures, or a source is damaged.
    """
    selection, spread = clip.selection(), Spread(SAMPLES)
    indices: list[int] = []
    path = str(clip.source.path)
    for shot in clip.shots(selection):
        spread.add(shot)
        indices.append(shot.index)
        if len(indices) > cfg.max_frames:
            expected = f"{clip.source.num_frames or 'more'} in the file"
            hint = "Choose a part with --start and --end, lower --frames-per-second, or raise --max-frames."
            raise complaint(path, f"at most {cfg.max_frames} frames", expected, hint)
    if len(indices) < 2:
        hint = "Check --start, --end and --frames-per-second."
        raise complaint(path, "at least 2 frames in the selection", str(len(indices)), hint)
    lefts = [shot.left for shot in spread.kept]
    remarks = _timing(selection.gaps, selection.uneven_steps, len(indices))
    strips = circle = None
    labels: list[Rectangle] = []
    if cfg.border == "auto":
        circle = find_circle(lefts)
        strips = find_strips(lefts) or None
        labels = [tuple(box) for box in find_static_overlays([_without(p, strips) for p in lefts])]
        remarks += _surroundings(strips, circle, labels)
    view = make_view(
        clip.eye_size,
        calibration,
        stereo=clip.stereo,
        name=name,
        field_of_view_degrees=cfg.field_of_view_degrees,
        max_width=cfg.max_width,
        crop=parse_rectangle(cfg.crop, "--crop") if cfg.crop else None,
        blank=[*labels, *(parse_rectangle(text, "--blank") for text in cfg.blank)],
        strips=strips,
        circle=circle,
    )
    if calibration is None:
        remarks.append(
            f"no calibration: a field of view of {cfg.field_of_view_degrees:g} degrees is assumed "
            f"(f = {view.matrix[0, 0]:.0f} px); --calibration or --field-of-view-degrees corrects it"
        )
    return Survey(indices, spread.kept, view, remarks)


def _without(picture: NDArray[np.uint8], strips: Strips | None) -> NDArray[np.uint8]:
    """The picture with its strips made black, so that their text is not found again."""
    if not strips:
        return picture
    height, width = picture.shape[:2]
    clean = np.zeros_like(picture)
    part = slice(strips.top, height - strips.bottom), slice(strips.left, width - strips.right)
    clean[part] = picture[part]
    return clean


def _timing(gaps: int, uneven: int, count: int) -> list[str]:
    remarks = []
    if uneven > max(2, 0.02 * count):
        remarks.append(f"variable frame rate: {uneven} uneven steps; pictures were taken on an even grid")
    if gaps:
        remarks.append(f"{gaps} moments of the grid have no picture of their own and are left out")
    return remarks


def _surroundings(strips: Strips | None, circle: Circle | None, labels: list[Rectangle]) -> list[str]:
    remarks = []
    if strips:
        sides = ", ".join(f"{n} px {side}" for side, n in vars(strips).items() if n)
        remarks.append(f"black bars or console strips cut off: {sides} (--border keep leaves them)")
    if circle:
        remarks.append(
            f"round border: center ({circle.center_x:.0f}, {circle.center_y:.0f}), radius {circle.radius:.0f} px; "
            "masked outside"
        )
    remarks += [f"burned-in label painted over: {x},{y},{w},{h}" for x, y, w, h in labels]
    return remarks


def source_facts(path: Path) -> dict[str, object]:
    """What tells one source from another: name, size and time of change of a file, or of the files of a folder."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.exists()]
    return {"name": path.name, "files": [list(entry) for entry in stats]}
