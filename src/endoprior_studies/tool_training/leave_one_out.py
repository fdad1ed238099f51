"""Train one network without each set, and one with all; score each on what it has not seen, and write the table."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from endoprior.system.atomic import whole_file, write_json, write_text
from endoprior.tool_masks import ToolFinder
from endoprior.tool_masks.network import ToolNetwork, network_from, weights_of
from endoprior.visualization.image_tools import label, write_png

from .benchmark import SHOWN, SetScore, pictures, score_set
from .fit import fit
from .footage import SETS, TRAINED, phantom_frames, phantom_sets, test_frames, training_frames

ALL = "all"
SPLIT = {"vocalfolds": ("seq2", "seq4", "seq5")}
"""Sets of several operations are scored by operation too."""
BARS = {"missed_core": (0.10, 0.05), "false_area": (0.03, 0.015), "false_frames": (0.02, 0.02)}
"""Largest value of the worst line, and of the mean."""
COLUMNS = {"iou": "IoU", "missed_core": "missed core", "false_area": "false area", "false_frames": "false frames"}
PICTURE_PX = (320, 240)
"""(width, height) of a frame on the sheet."""


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    name: str
    network: str
    """Which set the network has not seen; `all` for sets that are never trained on."""
    score: SetScore
    is_part: bool = False
    """Whether its frames are in another line too; such a line does not count in the mean."""


def weights_file(out: Path, left_out: str) -> Path:
    """Where the weights of a network are: `OUT/networks/without_SET.safetensors` or `all.safetensors`."""
    return out / "networks" / f"{left_out if left_out == ALL else f'without_{left_out}'}.safetensors"


@dataclass(frozen=True)
class Training:
    """How each network is trained."""

    steps: int
    seed: int
    start: ToolNetwork | None = None
    """Where each network starts; it must know no frame of the sets."""


def network_without(out: Path, root: Path, left_out: str, how: Training, say: Callable[[str], None]) -> ToolNetwork:
    """The network that has not seen a set; trained if its weights are not in `out` yet, resumed if interrupted."""
    file = weights_file(out, left_out)
    if not file.exists():
        names = [name for name in TRAINED if name != left_out]
        file.parent.mkdir(parents=True, exist_ok=True)
        checkpoint = file.with_suffix(".checkpoint")
        network = fit(
            training_frames(root, names),
            how.steps,
            how.seed,
            start=how.start,
            checkpoint=checkpoint,
            report=lambda step, loss: say(f"{file.stem}: step {step} of {how.steps}, loss {loss:.3f}"),
        )
        with whole_file(file) as temporary:
            temporary.write_bytes(weights_of(network))
        checkpoint.unlink(missing_ok=True)
    return network_from(file.read_bytes())


def rows(out: Path, root: Path, how: Training, say: Callable[[str], None]) -> Iterator[Row]:
    """Every line of the table, in its order: the sets, then the families of the phantom."""
    for name in SETS:
        left_out = name if name in TRAINED else ALL
        finder = ToolFinder(network_without(out, root, left_out, how, say))
        frames = list(test_frames(root, name))
        yield Row(name, left_out, score_set(finder, frames))
        for part in SPLIT.get(name, ()):
            of_part = [frame for frame in frames if frame.name.startswith(part)]
            yield Row(f"{name}: {part}", left_out, score_set(finder, of_part), is_part=True)
    finder = ToolFinder(network_without(out, root, ALL, how, say))
    for name, phantom in phantom_sets().items():
        yield Row(name, ALL, score_set(finder, phantom_frames(out / "phantoms", phantom)))


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
        whole = [value for value, is_part in values if not (is_part or math.isnan(value))]
        mean = sum(whole) / len(whole) if whole else math.nan
        numbers = " | ".join(map(_percent, (worst, most, mean, mean_most)))
        lines.append(f"| {COLUMNS[name]} | {numbers} |")
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
        small = np.asarray(cv2.resize(image, PICTURE_PX, interpolation=cv2.INTER_AREA), np.uint8)
        tiles.append(label(small, f"{row.name}: {name}" if not tiles else name))
    tiles += [np.zeros_like(tiles[0])] * (SHOWN - len(tiles))
    return np.concatenate(tiles, 1)


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.1%}"


def _plain(row: dict[str, object]) -> dict[str, object]:
    """The row with None in place of NaN, which JSON does not have."""
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in row.items()}
