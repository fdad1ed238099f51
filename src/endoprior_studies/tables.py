"""Results as tables in Markdown and LaTeX, and all single values as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from endoprior.evaluation.registry import all_scores
from endoprior.evaluation.score import Score

from .results import Results
from .statistics import Summary


@dataclass(frozen=True)
class Entry:
    """One number of a table."""

    text: str
    rank: int
    """1 for the best of its column, 2 for the second, 0 for others and for scores without a direction."""


@dataclass(frozen=True)
class Table:
    """A grid with names of rows and columns."""

    title: str
    columns: list[str]
    rows: list[tuple[str, list[Entry]]]


def score_table(results: Results, sequence: str, scores: Mapping[str, Score] | None = None, title: str = "") -> Table:
    """Mean and standard deviation over seeds of every score on one sequence; a row for each method and budget.

    Of several folds it is their mean.

    Args:
        scores: columns, if there is any value; default: those of the spec.
        title: default: the name of the sequence.
    """
    spec = results.spec
    sized = {method for method in spec.methods if spec.has_config(method)}
    # A method without a budget has one row, not the same one for every budget.
    rows = [
        (budget, method)
        for budget in (spec.budgets or (None,))
        for method in spec.methods
        if method in sized or not spec.budgets or budget == spec.budgets[0]
    ]
    about = {name: all_scores()[name] for name in spec.scores} if scores is None else scores
    columns = [score for score in about if any(results.summary(sequence, *row, score).count for row in rows)]
    by_column = []
    for score in columns:
        summaries = [results.summary(sequence, *row, score) for row in rows]
        ranks = _ranks(about[score], [value.mean for value in summaries])
        by_column.append([Entry(number(value), rank) for value, rank in zip(summaries, ranks, strict=True)])
    names = [spec.label(method) + (f", {budget:,}" if budget and method in sized else "") for budget, method in rows]
    return Table(
        title or sequence,
        [about[score].heading(sequence in results.relative) for score in columns],
        [(name, [column[i] for column in by_column]) for i, name in enumerate(names)],
    )


def _ranks(score: Score, means: list[float]) -> list[int]:
    higher_is_better = score.higher_is_better
    known = sorted({round(m, 12) for m in means if math.isfinite(m)}, reverse=bool(higher_is_better))
    if higher_is_better is None or len(known) < 2:
        return [0] * len(means)
    best = {value: rank for rank, value in enumerate(known[:2], 1)}
    return [best.get(round(m, 12), 0) if math.isfinite(m) else 0 for m in means]


def number(value: Summary) -> str:
    """`mean ± std` with two digits of the spread, at most five of the mean; a dash where there is no value."""
    if not value.count:
        return "-"
    single = not math.isfinite(value.std)
    spread = abs(value.mean) / 1000 if single else max(value.std, abs(value.mean) / 5000)
    digits = max(0, min(_decimals(spread, 2), _decimals(abs(value.mean), 5), 4))
    mean = f"{value.mean:,.{digits}f}"
    return mean if single else f"{mean} ± {value.std:,.{digits}f}"


def _decimals(size: float, significant: int) -> int:
    """Decimals that show so many significant digits of `size`; negative where some stand before the point."""
    return significant - 1 - math.floor(math.log10(size)) if size > 0 else 4


def markdown(table: Table) -> str:
    """The table in Markdown: best in bold, second best underlined by `<u>`."""
    marks = {0: "{}", 1: "**{}**", 2: "<u>{}</u>"}
    lines = [["method", *table.columns], ["---"] * (len(table.columns) + 1)]
    lines += [[name, *(marks[e.rank].format(e.text) for e in entries)] for name, entries in table.rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def latex(table: Table) -> str:
    """The table in LaTeX with booktabs: best in bold, second best underlined."""
    marks = {0: "{}", 1: r"\textbf{{{}}}", 2: r"\underline{{{}}}"}

    def cell(entry: Entry) -> str:
        return marks[entry.rank].format(entry.text.replace("±", r"$\pm$").replace(",", r"{,}"))

    lines = [" & ".join([_escaped(name), *map(cell, entries)]) + r" \\" for name, entries in table.rows]
    heads = " & ".join(["method", *map(_escaped, table.columns)])
    return "\n".join(
        [
            rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
            rf"% {table.title}",
            r"\toprule",
            heads + r" \\",
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}",
        ]
    )


def _escaped(text: str) -> str:
    for character in "\\&%$#_{}~^":
        text = text.replace(character, rf"\{character}" if character not in "\\~^" else " ")
    return text


def csv_lines(results: Results, more: Sequence[tuple[Any, ...]] = ()) -> str:
    """One line for each cell and score, then those of `more`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["sequence", "method", "budget", "seed", "fold", "score", "value"])
    for cell, scores in results.scores.items():
        for name, value in scores.items():
            writer.writerow([cell.sequence, cell.method, cell.budget or "", cell.seed, cell.fold, name, repr(value)])
    writer.writerows(more)
    return text.getvalue()
