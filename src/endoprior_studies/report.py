"""Write what a benchmark measured: results.md, results.tex, results.csv, results.json and figures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from endoprior.core.config_io import to_dict
from endoprior.evaluation.registry import all_scores
from endoprior.runs.log import growth_of
from endoprior.system.atomic import write_json, write_text

from .figures import GRIDS, budget_figure, curve_figure, write_image_grids
from .matrix import Matrix, commits_of, scores_of
from .results import Results
from .spec import ClaimSpec
from .statistics import Difference
from .tables import (
    csv_lines,
    grid,
    latex,
    markdown,
    matched_table,
    protocol_blocks,
    protocol_tables,
    protocol_values,
    published_blocks,
    published_table,
    score_table,
)

SHOWN_NAMES = 6


def write_report(matrix: Matrix, out: Path) -> Path:
    """Write tables, differences, claims and figures of the finished cells into `out`, and list the others.

    Returns:
        Path of `results.md`.
    """
    results = Results.of(matrix)
    _figures(matrix, results, out / "figures")
    tables = [score_table(results, name) for name in matrix.spec.sequences if name in matrix.data]
    tables += protocol_tables(matrix)
    if about := matrix.spec.published:
        tables.insert(0, published_table(results, about, [*matrix.data]))
    write_text(out / "results.tex", "\n\n".join(latex(table) for table in tables) + "\n")
    write_text(out / "results.csv", csv_lines(results, protocol_values(matrix)))
    write_json(out / "results.json", _facts(matrix, results))
    write_text(out / "results.md", "\n\n".join([*_body(matrix, results, out, out, 1), *_protocol([matrix], 2)]) + "\n")
    return out / "results.md"


def write_overview(reports: dict[Path, Matrix], out: Path) -> Path:
    """Put the reports of several specs into one `results.md` in `out`.

    Args:
        reports: matrix by the folder that `write_report` wrote, below `out`.
    """
    blocks = ["# Results"]
    for folder, matrix in reports.items():
        blocks += _body(matrix, Results.of(matrix), folder, out, 2)
    write_text(out / "results.md", "\n\n".join([*blocks, *_protocol(list(reports.values()), 2)]) + "\n")
    return out / "results.md"


def _body(matrix: Matrix, results: Results, folder: Path, base: Path, level: int) -> list[str]:
    """All blocks of one spec, its title at heading `level`; links to figures in `folder` are relative to `base`."""
    below = "#" * (level + 1)
    return [
        *_head(matrix, "#" * level),
        *published_blocks(matrix, results, below),
        *_tables(matrix, results, below),
        *claims_section(results, below),
        *_searches(matrix, below),
        *_silent(matrix, below),
        *protocol_blocks(matrix, below),
        *_figure_links(matrix, folder, base, below),
    ]


def _head(matrix: Matrix, mark: str) -> list[str]:
    spec = matrix.spec
    size = f"{len(spec.methods)} methods x {len(spec.sequences)} sequences"
    size += f" x {len(spec.budgets)} budgets" if spec.budgets else ""
    seeds = ", ".join(map(str, spec.seeds))
    lines = [f"{mark} {spec.title}"]
    if spec.about:
        lines.append(spec.about.strip())
    commits = ", ".join(commits_of(matrix)) or "none yet"
    over = "seeds"
    if several := {name: about.folds for name, about in spec.sequences.items() if len(about.folds) > 1}:
        size += "".join(f", folds {', '.join(map(str, folds))} of {name}" for name, folds in several.items())
        over = "seeds of the mean over folds (which frame of every eight is held out)"
    lines.append(f"{size}, seeds {seeds}; trained at commit {commits}. Mean ± standard deviation over {over}.")
    if matrix.missing:
        by_reason: dict[str, list[str]] = {}
        for cell, reason in matrix.missing.items():
            by_reason.setdefault(reason, []).append(f"`{cell.name}`")
        missing = "\n".join(f"- {_some(names)}: {reason}" for reason, names in by_reason.items())
        lines.append(f"No result for {len(matrix.missing)} cells:\n\n{missing}")
    return lines


def _some(names: list[str]) -> str:
    """The first names, and how many more there are."""
    rest = len(names) - SHOWN_NAMES
    return ", ".join(names[:SHOWN_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def _protocol(matrices: list[Matrix], level: int) -> list[str]:
    """The protocol of the scores, from the first finished cell that has all of it: images have no backend."""
    folders = [folder for matrix in matrices for folder in matrix.done.values()]
    if not folders:
        return []
    hidden = ("frames", "data_fingerprint", "trained_on", "shrink", "tags")
    whole = max((scores_of(folder)["protocol"] for folder in folders), key=len)
    shown = {name: text for name, text in whole.items() if name not in hidden}
    shown["split_rule"] = "; ".join(sorted({scores_of(folder)["protocol"]["split_rule"] for folder in folders}))
    return [f"{'#' * level} Protocol", "\n".join(f"- `{name}`: {text}" for name, text in shown.items())]


def _tables(matrix: Matrix, results: Results, mark: str) -> list[str]:
    blocks = []
    for name in matrix.spec.sequences:
        if name not in matrix.data:
            continue
        blocks += [f"{mark} {name}", "Best in bold, second best underlined.", markdown(score_table(results, name))]
        for compared in _comparisons(results, name):
            blocks += _differences(results, name, compared)
    return blocks


@dataclass(frozen=True)
class Compared:
    """Paired differences on one sequence, by method and score."""

    kind: Literal["differences", "gains_of_found_parts"]
    than: str
    """A method, or the sequence with its own parts."""
    label: str
    """The same in words."""
    by_method: dict[str, dict[str, Difference]]


def _comparisons(results: Results, sequence: str) -> Iterator[Compared]:
    """With the reference, and of found parts with a sequence's own; not of masks, whose scores all methods share."""
    spec, than = results.spec, results.spec.reference
    scores = [score for score in spec.scores if all_scores()[score].group != "masks"]
    others = [method for method in spec.methods if method != than]
    changes = {m: {s: results.difference(s, m, than, sequence) for s in scores} for m in others}
    yield Compared("differences", than, spec.label(than), changes)
    if own := spec.with_own_parts(sequence):
        changes = {m: {s: results.gain_of_found(s, m, sequence, own) for s in scores} for m in spec.methods}
        parts = " and ".join(spec.sequences[sequence].found_parts)
        yield Compared("gains_of_found_parts", own, f"{own}, which has its own {parts}", changes)


def _differences(results: Results, sequence: str, compared: Compared) -> list[str]:
    """A table with a line above it; nothing without pairs."""
    rows = compared.by_method
    known = [score for score in next(iter(rows.values()), {}) if any(row[score].count for row in rows.values())]
    if not known:
        return []
    headings = [all_scores()[score].heading(sequence in results.relative) for score in known]
    lines = [[results.spec.label(method), *(change(s, row[s]) for s in known)] for method, row in rows.items()]
    over_frames = any(row[s].over_frames for row in rows.values() for s in known)
    over = "seeds and, where scores have values of frames, these" if over_frames else "seeds"
    about = f"Paired difference to {compared.label}, positive where better, [95 % interval over {over}]:"
    return [about, grid(["method", *headings], lines)]


def change(score: str, difference: Difference) -> str:
    """`+3.1 % [+1.0, +5.2]` or `+0.31 dB [+0.10, +0.52]`; a dash where there is nothing to compare."""
    if not difference.count:
        return "-"
    about = all_scores()[score]
    relative = about.compare == "relative"
    factor, digits, unit = (100, 1, "%") if relative else (1, about.digits, about.unit)
    numbers = (difference.mean, difference.low, difference.high)
    mean, low, high = (f"{factor * value:+.{digits}f}" for value in numbers)
    interval = f"[{low}, {high}]" if math.isfinite(difference.low) else ""
    return " ".join(filter(None, (mean, unit, interval)))


def _amount(score: str, by: float) -> str:
    about = all_scores()[score]
    return f"{100 * by:g} %" if about.compare == "relative" else f"{by:g} {about.unit}".rstrip()


def claims_section(results: Results, mark: str) -> list[str]:
    """Paragraphs with the verdict of each claim, and what no sequence has a result for; `mark`: the heading's `#`s."""
    if not results.spec.claims:
        return []
    lines, missing = [], Counter()
    for claim in results.spec.claims:
        found = results.check(claim)
        if not found:
            missing[all_scores()[claim.score].heading(bool(results.relative))] += 1
            continue
        parts = [f"{name}: **{said}**, {change(claim.score, own)}" for name, (own, said) in found.items()]
        if len(found) > 1:
            parts.append(f"together {change(claim.score, results.together(claim))}")
        source = f" [{claim.text}]" if claim.text else ""
        lines.append(f"- {sentence(results, claim)}{source}: {'; '.join(parts)}.")
    if missing:
        lines.append(f"- Not measured: {'; '.join(f'{score} (claims: {n})' for score, n in missing.items())}.")
    note = "A verdict needs the whole 95 % interval on one side. Intervals are over seeds (there is none for one) and, "
    note += "where both methods have values of the same single frames, over these too."
    return [f"{mark} Claims", "\n".join(lines), note]


def _searches(matrix: Matrix, mark: str) -> list[str]:
    if not matrix.searches:
        return []
    about = "Searched with the first seed and fold; the others train with the threshold found."
    return [f"{mark} Thresholds found", about, matched_table(matrix.spec, matrix.searches)]


def _silent(matrix: Matrix, mark: str) -> list[str]:
    lines = silent_rules(matrix)
    return [f"{mark} Rules that never fired", "\n".join(f"- {line}." for line in lines)] if lines else []


def silent_rules(matrix: Matrix) -> list[str]:
    """A line for each method and sequence with a rule of density control that no Gaussian met in any cell.

    What a table says of such a rule is an artifact.
    """
    spec, lines = matrix.spec, []
    for sequence in spec.sequences:
        for method in spec.methods:
            folders = [f for cell, f in matrix.done.items() if (cell.sequence, cell.method) == (sequence, method)]
            grown = [growth for folder in folders if (growth := growth_of(folder / "run"))]
            changes = Counter[str]()
            for growth in grown:
                changes.update(growth.changes)
            words = (
                [] if changes["cloned"] + changes["split"] else ["nothing grew" if changes else "nothing grew or went"]
            )
            for name, count in changes.items():
                if name.startswith("removed_") and not count:
                    words.append(f"the rule {name.removeprefix('removed_')} removed nothing")
            if grown and words:
                events = sum(growth.num_events for growth in grown)
                lines.append(f"{spec.label(method)}, {sequence}: {', '.join(words)} in {events} density events")
    return lines


def sentence(results: Results, claim: ClaimSpec) -> str:
    """The claim in words."""
    ours, theirs = results.spec.label(claim.method), results.spec.label(claim.than)
    score, by = all_scores()[claim.score].heading(bool(results.relative)), _amount(claim.score, claim.by)
    at = f" at {claim.budget:,} initial Gaussians" if claim.budget else ""
    if claim.expect == "better":
        return f"{ours} is better than {theirs} in {score}" + (f" by at least {by}" if claim.by else "") + at
    if claim.expect == "no worse":
        return f"{ours} is no worse than {theirs} in {score}" + (f" by more than {by}" if claim.by else "") + at
    return f"{ours} and {theirs} differ in {score} by no more than {by}{at}"


def _figures(matrix: Matrix, results: Results, folder: Path) -> None:
    kinds: set[str] = set(matrix.spec.figures)
    if not matrix.done:
        return
    if "budgets" in kinds:
        budget_figure(results, folder / "budgets.png")
    if "curves" in kinds:
        curve_figure(results, matrix, folder / "curves.png")
    write_image_grids(matrix, folder, kinds)


def _figure_links(matrix: Matrix, folder: Path, base: Path, mark: str) -> list[str]:
    names = ["budgets", "curves", *(f"{kind}-{name}" for name in matrix.data for kind in GRIDS)]
    wanted = [folder / "figures" / f"{name}.png" for name in names if name.split("-")[0] in matrix.spec.figures]
    links = [f"![{path.stem}]({path.relative_to(base).as_posix()})" for path in wanted if path.exists()]
    return [f"{mark} Figures", *links] if links else []


def _facts(matrix: Matrix, results: Results) -> dict[str, Any]:
    """Everything in the tables, for other programs."""
    spec = matrix.spec
    cells = [
        {"sequence": c.sequence, "method": c.method, "budget": c.budget, "seed": c.seed, "fold": c.fold}
        | {"folder": folder.name}
        | scores_of(folder)
        for c, folder in matrix.done.items()
    ]
    claims = []
    for claim in spec.claims:
        found = {name: {"verdict": said} | _json(own) for name, (own, said) in results.check(claim).items()}
        about = {"sequences": found, "together": _json(results.together(claim)), "sentence": sentence(results, claim)}
        claims.append(to_dict(claim) | about)
    pairs = {"differences": [], "gains_of_found_parts": []}
    for name in spec.sequences:
        for compared in _comparisons(results, name):
            pairs[compared.kind] += [
                {"sequence": name, "method": method, "than": compared.than, "score": score} | _json(difference)
                for method, row in compared.by_method.items()
                for score, difference in row.items()
            ]
    return {
        "spec": to_dict(spec) | {"folder": None},
        "commits": commits_of(matrix),
        "cells": cells,
        **pairs,
        "claims": claims,
        "silent_rules": silent_rules(matrix),
        "thresholds": [
            {"sequence": s, "method": m, "budget": b, "failure": search.failure, "target": _finite(search.target)}
            | {"tried": [{"threshold": value, "gaussians": growth.last} for value, growth in search.tried]}
            for (s, m, b), search in matrix.searches.items()
        ],
        "missing": {cell.name: reason for cell, reason in matrix.missing.items()},
    }


def _json(difference: Difference) -> dict[str, Any]:
    numbers = {"mean": difference.mean, "low": difference.low, "high": difference.high}
    pairs = {"pairs": difference.count, "over_frames": difference.over_frames}
    return {name: _finite(value) for name, value in numbers.items()} | pairs


def _finite(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None
