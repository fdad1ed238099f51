"""Write the table of the tool benchmark: Markdown, JSON, and a sheet with frames of each set, good and bad."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from endoprior.system.atomic import write_json, write_text
from endoprior.visualization.image_tools import label, write_png

from .benchmark import SHOWN, pictures
from .leave_one_out import ALL, Row

BARS = {"missed_core": (0.10, 0.05), "false_area": (0.03, 0.015), "false_frames": (0.02, 0.02)}
"""Largest value of the worst line, and of the mean."""
COLUMNS = {"iou": "IoU", "missed_core": "missed core", "false_area": "false area", "false_frames": "false frames"}
PICTURE_PX = (320, 240)
"""(width, height) of a frame on the sheet."""


def write_report(out: Path, table: Sequence[Row], settings: dict[str, object]) -> Path:
    """Write `masks.md`, `masks.json` and `masks.png` into `out`; returns the first."""
    lines = ["# Tools found by a network that has not seen the set", ""]
    lines += [", ".join(f"{name} {value}" for name, value in settings.items()), ""]
    lines += [f"| set | network | {' | '.join(COLUMNS.values())} |", "|---" * (2 + len(COLUMNS)) + "|"]
    for row in table:
        seen = "trained on all sets, not this" if row.network == ALL else f"without {row.network}"
        scores = row.score.total.scores()
        lines.append(f"| {row.name} | {seen} | {' | '.join(_percent(scores[name]) for name in COLUMNS)} |")
    lines += ["", "| bar | worst | allowed | mean | allowed |", "|---|---|---|---|---|"]
    for name, (most, mean_most) in BARS.items():
        values = [(row.score.total.scores()[name], row.is_part) for row in table]
        worst = max((value for value, _ in values if not math.isnan(value)), default=math.nan)
        mean = _mean([value for value, is_part in values if not (is_part or math.isnan(value))])
        lines.append(
            f"| {COLUMNS[name]} | {_percent(worst)} | {_percent(most)} | {_percent(mean)} | {_percent(mean_most)} |"
        )
    file = out / "masks.md"
    write_text(file, "\n".join(lines) + "\n")
    rows = [{"set": row.name, "network": row.network, **row.score.total.scores()} for row in table]
    write_json(out / "masks.json", {"settings": settings, "rows": [_plain(row) for row in rows]})
    sheet = [_strip(row) for row in table if row.score.shown]
    if sheet:
        write_png(out / "masks.png", np.concatenate(sheet))
    return file


def _strip(row: Row) -> NDArray[np.uint8]:
    """The best, a middle and the worst frame of a line side by side: green found, red missed, blue false."""
    tiles = []
    for name, image in pictures(row.score):
        small = cv2.resize(image, PICTURE_PX, interpolation=cv2.INTER_AREA)
        tiles.append(label(small, f"{row.name}: {name}" if not tiles else name))
    tiles += [np.zeros_like(tiles[0])] * (SHOWN - len(tiles))
    return np.concatenate(tiles, 1)


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.1%}"


def _plain(row: dict[str, object]) -> dict[str, object]:
    """The row with None in place of NaN, which JSON does not have."""
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in row.items()}
