"""Results as tables in Markdown and LaTeX, also under protocols of other papers and beside published figures; as CSV.

published.csv has figures by method, whose they are, data and initial budget, in columns named as our scores;
published_tags.csv how the released script of each method scores. docs/results.md explains both.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from endoprior.evaluation.protocols.table import KEYS, PROTOCOLS, SCORES
from endoprior.evaluation.registry import all_scores
from endoprior.evaluation.score import Score

from .matched_count import Place, Search, matches_of
from .matrix import Matrix, scores_of
from .results import Results
from .spec import Cell, MatchSpec, PublishedSpec, Spec
from .statistics import Summary, summary

TRAINING = "psnr_train"


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
        scores: columns, if there is any value; default: those of the spec, `with_training`.
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
    about = {name: all_scores()[name] for name in with_training(spec.scores)} if scores is None else scores
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


def with_training(scores: Sequence[str]) -> list[str]:
    """The columns of a table: behind the PSNR of held-out frames that of training frames, which tells chance apart."""
    of_test = [name for name in scores if name in ("psnr", "psnr_tissue")]
    if not of_test or TRAINING in scores:
        return [*scores]
    place = scores.index(of_test[-1]) + 1
    return [*scores[:place], TRAINING, *scores[place:]]


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
    rows = ([name, *(marks[e.rank].format(e.text) for e in entries)] for name, entries in table.rows)
    return grid(["method", *table.columns], rows)


def grid(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *rows))


def latex(table: Table) -> str:
    """The table in LaTeX with booktabs: best in bold, second best underlined."""
    marks = {0: "{}", 1: r"\textbf{{{}}}", 2: r"\underline{{{}}}"}

    def cell(entry: Entry) -> str:
        return marks[entry.rank].format(entry.text.replace("±", r"$\pm$").replace(",", r"{,}"))

    lines = [" & ".join([_escaped(name), *map(cell, entries)]) + r" \\" for name, entries in table.rows]
    heads = " & ".join(["method", *map(_escaped, table.columns)]) + r" \\"
    begin = [rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}", rf"% {table.title}", r"\toprule"]
    return "\n".join([*begin, heads, r"\midrule", *lines, r"\bottomrule", r"\end{tabular}"])


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


def protocol_tables(matrix: Matrix) -> list[Table]:
    """A table for each protocol and sequence that has a score."""
    return [table for name in matrix.spec.protocols for table in _tables(matrix, name).values()]


def protocol_blocks(matrix: Matrix, mark: str) -> list[str]:
    """The blocks of `results.md`: for each protocol what it is, its tags on each sequence, and its tables."""
    blocks: list[str] = []
    for name in matrix.spec.protocols:
        about, tables = PROTOCOLS.load(name), _tables(matrix, name)
        published = "; ".join(f"{KEYS[tag]}: {text}" for tag, text in about.paper)
        blocks.append(f"{mark} Protocol {name}")
        blocks.append(f"As {about.title} is scored ({about.source}). As published: {published}.")
        blocks += ["\n".join(f"- {sentence}" for sentence in about.differs)] if about.differs else []
        for sequence in matrix.data:
            cells = [
                scores_of(matrix.done[cell])["protocols"][name] for cell in matrix.done if cell.sequence == sequence
            ]
            for tags in dict.fromkeys(_tags(cell) for cell in cells if cell["tags"]):
                blocks.append(f"{sequence}, scored here: {tags}.")
            if sequence in tables:
                blocks.append(markdown(tables[sequence]))
            if skipped := dict.fromkeys(SCORES[score].label for cell in cells for score in cell["skipped"]):
                blocks.append(f"Not computed on {sequence}: {', '.join(skipped)}; `results.json` has the reasons.")
    return blocks


def protocol_values(matrix: Matrix) -> list[tuple[Any, ...]]:
    """Rows for `results.csv`; the score is named `endonerf/psnr`."""
    return [
        (cell.sequence, cell.method, cell.budget or "", cell.seed, cell.fold, f"{name}/{score}", repr(value))
        for name in matrix.spec.protocols
        for cell, scores in Results.of(matrix, name).scores.items()
        for score, value in scores.items()
    ]


def _tables(matrix: Matrix, name: str) -> dict[str, Table]:
    results = Results.of(matrix, name)
    tables = {sequence: score_table(results, sequence, SCORES, f"{sequence}, {name}") for sequence in matrix.data}
    return {sequence: table for sequence, table in tables.items() if table.columns}


def _tags(cell: dict[str, Any]) -> str:
    return "; ".join(f"{KEYS[tag]}: {text}" for tag, text in cell["tags"].items())


def matched_table(spec: Spec, searches: dict[Place, Search]) -> str:
    """A Markdown table: what was wanted, and what was found."""
    matches, rows = matches_of(spec), []
    for (sequence, method, budget), search in searches.items():
        name = spec.label(method) + (f", {budget:,}" if budget else "")
        rows.append([name, sequence, *_words(matches[sequence, method, budget], search), str(len(search.tried))])
    return grid(("method", "sequence", "threshold of growth", "Gaussians", "wanted", "trainings"), rows)


def _words(match: MatchSpec, search: Search) -> tuple[str, str, str]:
    """The threshold, what it gave and what was wanted, in words."""
    if search.failure:
        return f"none: {search.failure}", "-", "-"
    value = f"{search.best[0]:.3g}"
    if match.value_of:
        return value, "-", f"threshold of {match.value_of}"
    why = f"as {match.count_of}" if match.count_of else f"{match.growth:g} times the start"
    missed = "" if search.matched else " (not reached)"
    return value, f"{search.best[1].last:,}{missed}", f"{search.target:,.0f}: {why}"


FIGURES, TAGS = (Path(__file__).parent / name for name in ("published.csv", "published_tags.csv"))
AUTHORS = "its authors"
OURS = "EndoPrior-GS"
"""The row of published_tags.csv that scores here follow."""
Row = dict[str, str]


def rows_of(file: Path) -> list[Row]:
    """The rows of a CSV file by the names of its columns."""
    return list(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))


def published_table(results: Results, about: PublishedSpec, sequences: list[str]) -> Table:
    """Below the published figures of each method and budget those of the methods here that stand for it.

    Args:
        sequences: those that are there; figures are means over them, then mean and standard deviation over seeds.
    """
    rows = [row for row in rows_of(FIGURES) if row["source"].startswith(about.table) and row["data"] == about.data]
    spec = results.spec
    scores = [score for score in spec.scores if any(row.get(score) for row in rows)]

    def here(method: str, budget: int | None) -> tuple[str, list[Entry]]:
        values = {
            score: [
                float(np.mean([results.value(Cell(name, method, budget, seed), score) for name in sequences]))
                for seed in spec.seeds
            ]
            for score in scores
        }
        return f"{spec.label(method)}: here", [Entry(number(summary(values[score])), 0) for score in scores]

    table = []
    for name, budget in dict.fromkeys((row["method"], row["budget"]) for row in rows):
        for row in rows:
            if (row["method"], row["budget"]) == (name, budget):
                whose = f"by {AUTHORS}" if row["by"] == AUTHORS else "published"
                label = f"{name}, {int(budget):,}: {whose}" if budget else f"{name}: {whose}"
                table.append((label, [Entry(row[score] or "-", 0) for score in scores]))
        budget = int(budget) if budget else None
        table += [here(m, budget) for m, a in spec.methods.items() if a.published == name and sequences]
    for budget in spec.budgets or (None,):
        table += [here(m, budget) for m, a in spec.methods.items() if not a.published and sequences]
    return Table(f"{about.table}, {about.data}", [all_scores()[score].heading(False) for score in scores], table)


def published_blocks(matrix: Matrix, results: Results, mark: str) -> list[str]:
    """The blocks of `results.md`: the table, and what differs; nothing if the spec repeats no published table."""
    if not (about := matrix.spec.published):
        return []
    blocks, spec = [f"{mark} Published and here"], matrix.spec
    if spec.iterations:
        short = f"**Shortened: every method trained {spec.iterations:,} iterations in place of its own schedule.**"
        blocks.append(f"{short} The figures here say nothing about the methods.")
    blocks.append(markdown(published_table(results, about, [name for name in spec.sequences if name in matrix.data])))
    differs = [*_of_this_run(matrix, about), *about.differs, *_of_authors(about)]
    return [*blocks, "What differs from the published protocol:", "\n".join(f"- {text}." for text in differs)]


def _of_this_run(matrix: Matrix, about: PublishedSpec) -> list[str]:
    """What follows from the run: its sequences, sizes, seeds, split, renderer, and scores without a value."""
    spec, texts = matrix.spec, list[str]()
    given = [name for name in spec.sequences if name in matrix.data]
    here = "as here" if len(given) == len(spec.sequences) else f"here {', '.join(given) or 'there are none'}"
    texts.append(f"Published: means over {', '.join(spec.sequences)}; {here}")
    for name, (_, *size) in matrix.extents.items():
        if tuple(size) != about.size:
            texts.append("{}: {} x {} pixels; published: {} x {}".format(name, *size, *about.size))
    texts.append(f"Seeds here: {', '.join(map(str, spec.seeds))}; published: not said")
    done = [scores_of(folder) for folder in matrix.done.values()]
    protocols, skipped, published = [one["protocol"] for one in done], dict[str, str](), rows_of(FIGURES)[0]
    for one in done:
        skipped |= {score: why for score, why in one["skipped"].items() if score in published}
    for text in dict.fromkeys(protocol["split_rule"] for protocol in protocols):
        texts.append(f"Split here: {text}; published: 7:1 at a fixed interval")
    for backend, fps in dict.fromkeys((p["backend"], p["fps"].split("; ")[-1]) for p in protocols if "backend" in p):
        texts.append(f"Rendered here by `{backend}` on {fps}; published: by CUDA on an NVIDIA RTX 6000 Ada")
    return texts + [f"{all_scores()[s].label}: no value here: {why.rstrip('.')}" for s, why in skipped.items()]


def _of_authors(about: PublishedSpec) -> list[str]:
    """The tags of the figures by the authors of a method, where they differ from those of the protocol here."""
    tags = {row["method"]: row for row in rows_of(TAGS)}
    shown = [r["method"] for r in rows_of(FIGURES) if r["source"].startswith(about.table) and r["by"] == AUTHORS]
    texts = []
    for name in dict.fromkeys(shown):
        same = ("-", "test, the same rule", *tags[OURS].values())
        others = [tag for tag in list(tags[OURS])[2:] if tags[name][tag] not in same]
        rules = "; ".join(f"{tag}: {tags[name][tag]} (here {tags[OURS][tag]})" for tag in others)
        texts += [f"{name} by {AUTHORS}: {rules}"] if rules else []
    return texts
