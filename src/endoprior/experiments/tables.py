"""Results as tables: one model of a table, printed as Markdown and as LaTeX; all single values as CSV."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass

from .results import Results
from .statistics import HIGHER_IS_BETTER, Summary

LABELS = {
    "psnr": "PSNR, dB",
    "psnr_tissue": "tissue PSNR, dB",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "lpips_squeeze": "LPIPS (squeeze)",
    "depth_rmse_mm": "depth RMSE, mm",
    "depth_rmse_endogaussian": "depth RMSE (EndoGaussian's)",
    "flow_error": "flow error, px",
    "flow_error_dis": "flow error (DIS), px",
    "flow_error_raft_small": "flow error (RAFT-small), px",
    "depth_instability_mm": "depth instability, mm",
    "strict_psnr": "strict PSNR, dB",
    "strict_ssim": "strict SSIM",
    "flow_error_dis_adjacent": "flow error, adjacent (DIS), px",
    "num_gaussians": "Gaussians",
    "num_low_prior": "low prior",
    "num_low_opacity": "low opacity",
    "num_large_scale": "large scale",
    "psnr_behind_tool": "PSNR behind tool, dB",
    "depth_rmse_behind_tool_mm": "depth behind tool, mm",
    "track_error_mm": "track error, mm",
    "track_error_px": "track error, px",
    "track_fold_rate": "folds",
    "track_tear_rate": "tears",
    "train_seconds": "training, s",
    "fps": "frames/s",
}
"""Heading of each score; others stand under their own name."""
DIRECTIONLESS = frozenset({"num_gaussians", "num_low_prior", "num_low_opacity", "num_large_scale"})
"""Counts that are neither good nor bad, and are not ranked."""


@dataclass(frozen=True)
class Entry:
    """One number of a table."""

    text: str
    rank: int
    """1 for the best of its column, 2 for the second, 0 for others and for columns without a direction."""


@dataclass(frozen=True)
class Table:
    """A grid with names of rows and columns."""

    title: str
    columns: list[str]
    rows: list[tuple[str, list[Entry]]]


def score_table(results: Results, sequence: str) -> Table:
    """Mean and standard deviation over seeds of every score on one sequence; a row for each method and budget."""
    spec = results.spec
    rows = [(budget, method) for budget in (spec.budgets or (None,)) for method in spec.methods]
    columns = [score for score in spec.scores if any(results.summary(sequence, *row, score).count for row in rows)]
    by_column = []
    for score in columns:
        found = [results.summary(sequence, *row, score) for row in rows]
        ranks = _ranks(score, [value.mean for value in found])
        by_column.append([Entry(number(value), rank) for value, rank in zip(found, ranks, strict=True)])
    names = [spec.label(method) + (f", {budget:,}" if budget else "") for budget, method in rows]
    return Table(
        sequence,
        [LABELS.get(score, score) for score in columns],
        [(name, [column[i] for column in by_column]) for i, name in enumerate(names)],
    )


def _ranks(score: str, means: list[float]) -> list[int]:
    known = sorted({round(m, 12) for m in means if math.isfinite(m)}, reverse=score in HIGHER_IS_BETTER)
    if score in DIRECTIONLESS or len(known) < 2:
        return [0] * len(means)
    best = {value: rank for rank, value in enumerate(known[:2], 1)}
    return [best.get(round(m, 12), 0) if math.isfinite(m) else 0 for m in means]


def number(value: Summary) -> str:
    """`mean ± std` with two digits of the spread but five of the mean at most; a dash where there is no value."""
    if not value.count:
        return "-"
    alone = not math.isfinite(value.std)
    spread = abs(value.mean) / 1000 if alone else max(value.std, abs(value.mean) / 5000)
    digits = max(0, min(_decimals(spread, 2), _decimals(abs(value.mean), 5), 4))
    mean = f"{value.mean:,.{digits}f}"
    return mean if alone else f"{mean} ± {value.std:,.{digits}f}"


def _decimals(size: float, significant: int) -> int:
    """Decimals that show so many digits of `size`; negative where some lie before the point."""
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


def csv_lines(results: Results) -> str:
    """One line for each cell and score."""
    written = io.StringIO()
    writer = csv.writer(written, lineterminator="\n")
    writer.writerow(["sequence", "method", "budget", "seed", "score", "value"])
    for cell, scores in results.scores.items():
        for name, value in scores.items():
            writer.writerow([cell.sequence, cell.method, cell.budget or "", cell.seed, name, repr(value)])
    return written.getvalue()
