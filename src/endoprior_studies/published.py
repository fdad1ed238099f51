"""The published table that a spec repeats beside what was measured here, and what differs between the two.

published.csv has figures by method, whose they are, data and initial budget, in columns named as our scores;
published_tags.csv how the released script of each method scores. docs/results.md explains both.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from endoprior.evaluation.registry import all_scores

from .matrix import Matrix, scores_of
from .results import Results
from .spec import Cell, PublishedSpec
from .statistics import summary
from .tables import Entry, Table, markdown, number

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
    protocols, skipped = [one["protocol"] for one in done], dict[str, str]()
    for one in done:
        skipped |= {score: why for score, why in one["skipped"].items() if score in rows_of(FIGURES)[0]}
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
