"""Every stage in turn, compared with a baseline: `make bench`, or

    python bench/run.py [--quick] [--only STAGE ...] [--json FILE] [--baseline FILE] [--factor 1.5]

With a baseline, each row's ratio (ours / torch, taken in turn in one process) is divided by the baseline's. The exit
status is 1 if one of them grew by more than `--factor`, and did so again when its stage was measured a second time.
Rows in which ours takes less than MIN_MS are not judged, nor those without a ratio in both.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import common
import iteration
import ops
import rendering
import stereo
import viewer
from common import Row

STAGES: dict[str, common.Measure] = {
    "projection": rendering.projection,
    "binning": rendering.binning,
    "compositing": rendering.compositing,
    "ops": ops.measure,
    "rasterize": rendering.public,
    "rendering": rendering.rendering,
    "stereo": stereo.measure,
    "viewer": viewer.measure,
    "iteration": iteration.measure,
}
Ratios = dict[tuple[Any, ...], float]
"""ours / torch by `key`."""
FACTOR = 1.5
"""Machines are noisy: a ratio may be this many times the baseline's."""
MIN_MS = 0.5
"""Shorter medians say more about the clock than about the code."""


def load_ratios(file: Path) -> Ratios:
    stored = json.loads(file.read_text(encoding="utf-8"))["rows"]
    rows = [Row(**{k: v for k, v in row.items() if k != "ratio"}) for row in stored]
    return {key(row): row.ratio for row in rows if row.ratio is not None}


def key(row: Row) -> tuple[Any, ...]:
    return row.stage, row.gaussians, row.width, row.height


def changes(rows: list[Row], baseline: Ratios) -> dict[Row, float]:
    """Ratio now / ratio then, of the rows that can be compared; above 1 is worse."""
    return {row: row.ratio / baseline[key(row)] for row in rows if row.ratio is not None and key(row) in baseline}


def worse(changed: dict[Row, float], factor: float) -> list[Row]:
    return [row for row, change in changed.items() if change > factor and row.ours_ms >= MIN_MS]


def measure(stage: str, sizes: tuple[common.Size, ...], baseline: Ratios, factor: float) -> list[Row]:
    """The rows of a stage; if one looks slower, the better of two measurements."""
    rows = STAGES[stage](sizes)
    if worse(changes(rows, baseline), factor):
        again = STAGES[stage](sizes)
        rows = [min(pair, key=lambda row: row.ratio or 0.0) for pair in zip(rows, again, strict=True)]
    return rows


def main() -> int:
    parser = common.arguments(__doc__)
    parser.add_argument("--only", nargs="+", choices=STAGES, default=list(STAGES), metavar="STAGE")
    parser.add_argument("--baseline", type=Path, metavar="FILE", help="an earlier --json FILE")
    parser.add_argument("--factor", type=float, default=FACTOR, help="a ratio may grow by this (default %(default)s)")
    options = parser.parse_args()
    common.set_threads(options.threads)
    baseline = load_ratios(options.baseline) if options.baseline else {}
    rows = []
    for stage in options.only:
        began = time.perf_counter()
        rows += measure(stage, common.sizes(options), baseline, options.factor)
        print(f"{stage}: {time.perf_counter() - began:.0f} s", file=sys.stderr)
    changed = changes(rows, baseline)
    slower = worse(changed, options.factor)
    notes = {row: f"{change:.2f} x baseline{'  SLOWER' if row in slower else ''}" for row, change in changed.items()}
    common.report(rows, options, notes)
    if options.baseline:
        print(f"{len(changed)} ratios compared; {len(slower)} more than {options.factor} times the baseline's")
    return 1 if slower else 0


if __name__ == "__main__":
    sys.exit(main())
