"""The table of a batch: scores of every job that is done, and why the others failed."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from ..data import load_sequence
from ..data.files import read_json
from ..evaluation.registry import all_scores
from ..system.atomic import write_text
from .batch import Outcome
from .steps import SHOWN_SCORES

SUMMARY, TABLE = "summary.md", "scores.csv"
"""Files in the folder of a batch: the main scores to read, and all scores as numbers."""


def write_summary(outcomes: Sequence[Outcome], out: Path) -> list[str]:
    """Write the table of a batch to `SUMMARY` and `TABLE` in `out`.

    Returns:
        The lines of `SUMMARY`.
    """
    done = [outcome.entry for outcome in outcomes if not outcome.failure]
    scores = {entry.name: read_json(entry.job.run / "metrics.json")["scores"] for entry in done}
    known = [all_scores()[name] for name in SHOWN_SCORES if any(name in found for found in scores.values())]
    lines = []
    if done:
        lines = [f"| | {' | '.join(score.label for score in known)} |", f"|---|{'---|' * len(known)}"]
    for entry in done:
        relative, found = load_sequence(entry.job.data, entry.job.cfg.data).depth_is_relative, scores[entry.name]
        cells = [score.text(found[score.name], relative) if score.name in found else "" for score in known]
        lines.append(f"| {entry.name} | {' | '.join(cells)} |")
    if failed := [outcome for outcome in outcomes if outcome.failure]:
        lines += ([""] if done else []) + ["Failed:", ""]
        lines += [f"- {outcome.entry.name}: {outcome.failure}" for outcome in failed]
    write_text(out / SUMMARY, "\n".join(lines) + "\n")
    _write_table(scores, out / TABLE)
    return lines


def _write_table(scores: dict[str, dict[str, float]], file: Path) -> None:
    """One row for each job, one column for each score that any of them has."""
    columns = list(dict.fromkeys(name for found in scores.values() for name in found))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["name", *columns])
    writer.writerows([name, *(found.get(column, "") for column in columns)] for name, found in scores.items())
    write_text(file, text.getvalue())
