"""What every benchmark shares: sizes, the alternating clock, rows of results, the table and the JSON file.

Import this module before torch: it tells OpenMP's idle threads to sleep, as the command line of the package does. With
the default they spin on the cores that Numba's threads need, and everything takes up to three times as long.

A stage is raced: ours and plain torch's take turns in one process on the same inputs, and medians are compared. Ratios
of such pairs survive a change of machine and its noise far better than milliseconds do.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import argparse
import json
import platform
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import llvmlite.binding
import numba
import torch

from endoprior.system.installation import source_commit

Steps = dict[str, Callable[[Any], Any]]
"""One way to do a stage: what to call in turn, each with the result of the one before. `_names` are not reported."""

WARM_UP = 2
"""Uncounted laps of ours, and one of torch: compilation, first touch of memory."""
TURN_MS, MAX_TURNS, MIN_LAPS = 2000.0, 25, 9
"""The two take turns for about that long; ours runs a few more times where torch leaves it too few."""
COLD_MS = 4000.0
"""A first lap of torch that takes longer counts itself, and is the only one."""


class Size(NamedTuple):
    """One scene: number of Gaussians and picture."""

    num: int
    width: int
    height: int


QUICK = (Size(20_000, 640, 512),)
FULL = (
    Size(5_000, 320, 256),
    Size(20_000, 320, 256),
    Size(5_000, 640, 512),
    Size(20_000, 640, 512),
    Size(80_000, 640, 512),
    Size(20_000, 1280, 1024),
    Size(80_000, 1280, 1024),
)
"""The number varies with the picture fixed, the picture with the number fixed, and both together."""


@dataclass(frozen=True)
class Row:
    """One measurement."""

    stage: str
    gaussians: int | None
    """None where the stage does not depend on it; likewise for the picture."""
    width: int | None
    height: int | None
    ours_ms: float
    """Median milliseconds."""
    torch_ms: float | None = None
    """The same in plain torch; None where it would take too long or there is nothing to compare with."""
    share: float | None = None
    """Part of the whole it was measured in, 0..1."""

    @property
    def ratio(self) -> float | None:
        """ours / torch; smaller is better."""
        return None if self.torch_ms is None else self.ours_ms / self.torch_ms

    @property
    def size(self) -> str:
        """For people: `20,000 640x512`."""
        gaussians = "" if self.gaussians is None else f"{self.gaussians:,}"
        return f"{gaussians} {'' if self.width is None else f'{self.width}x{self.height}'}".strip()


Measure = Callable[[tuple[Size, ...]], list[Row]]
"""What each stage's file offers as `measure`."""


def nums(sizes: tuple[Size, ...]) -> list[int]:
    """The different numbers of Gaussians, for stages that do not see the picture."""
    return sorted({size.num for size in sizes})


def pictures(sizes: tuple[Size, ...]) -> list[tuple[int, int]]:
    """The different widths and heights, for stages that do not see the Gaussians."""
    return sorted({(size.width, size.height) for size in sizes})


def lap(steps: Steps) -> dict[str, float]:
    """Milliseconds of each step, once."""
    result, taken = None, {}
    for name, step in steps.items():
        began = time.perf_counter()
        result = step(result)
        taken[name] = 1e3 * (time.perf_counter() - began)
    return taken


def race(ours: Steps, theirs: Steps | None = None) -> dict[str, tuple[float, float | None]]:
    """Median milliseconds of each step, ours and plain torch's, taken in turn.

    Args:
        ours, theirs: the same reported steps under the same names; `theirs` may be None.
    """
    for _ in range(WARM_UP):
        first = lap(ours)
    taken = {"ours": defaultdict(list), "theirs": defaultdict(list)}

    def count(who: str, laps: dict[str, float]) -> None:
        for name, milliseconds in laps.items():
            taken[who][name].append(milliseconds)

    length = sum(first.values())
    if theirs is not None:
        first = lap(theirs)
        length += sum(first.values())
    turns = min(max(int(TURN_MS / length), 1), MAX_TURNS)
    cold = theirs is not None and sum(first.values()) > COLD_MS
    if cold:
        count("theirs", first)
    laps = max(turns, MIN_LAPS)
    for turn in range(turns):
        # Ours is spread evenly over the turns.
        for _ in range(laps * turn // turns, laps * (turn + 1) // turns):
            count("ours", lap(ours))
        if theirs is not None and not cold:
            count("theirs", lap(theirs))
    medians = {who: {name: statistics.median(ms) for name, ms in names.items()} for who, names in taken.items()}
    return {name: (ms, medians["theirs"].get(name)) for name, ms in medians["ours"].items() if not name.startswith("_")}


def rows(
    stage: str,
    result: dict[str, tuple[float, float | None]],
    num: int | None = None,
    picture: tuple[int | None, int | None] = (None, None),
) -> list[Row]:
    return [Row(f"{stage} {name}".strip(), num, *picture, *values) for name, values in result.items()]


@contextmanager
def stopwatch(parts: dict[str, list[tuple[object, str]]]) -> Iterator[dict[str, float]]:
    """Time, inside a running whole, the functions (owner, name) that make up each part.

    Yields milliseconds by part, which grow as the functions are called; the time of a part inside another counts for
    the inner one alone.
    """
    taken = dict.fromkeys(parts, 0.0)
    inner = [0.0]

    def timed(part: str, function: Callable) -> Callable:
        def call(*args: Any, **options: Any) -> Any:
            inner.append(0.0)
            began = time.perf_counter()
            try:
                return function(*args, **options)
            finally:
                whole = 1e3 * (time.perf_counter() - began)
                taken[part] += whole - inner.pop()
                inner[-1] += whole

        return call

    with ExitStack() as stack:
        for part, functions in parts.items():
            for owner, name in functions:
                stack.enter_context(mock.patch.object(owner, name, timed(part, getattr(owner, name))))
        yield taken


def part_rows(whole: str, steps: Steps, parts: dict[str, list[tuple[object, str]]], size: Size) -> list[Row]:
    """Rows of the parts of a whole stage, and of what is left of it, with their shares: means over a few laps."""
    began = time.perf_counter()
    with stopwatch(parts) as taken:
        for _ in range(MIN_LAPS):
            lap(steps)
    whole_ms = 1e3 * (time.perf_counter() - began)
    taken["the rest"] = max(whole_ms - sum(taken.values()), 0.0)
    return [Row(f"{whole}: {part}", *size, ms / MIN_LAPS, share=ms / whole_ms) for part, ms in taken.items()]


def facts() -> dict[str, Any]:
    """What must be known to read the numbers: commit, processor, threads, versions."""
    names = ("endoprior", "torch", "numba", "numpy", "scipy")
    return {
        "commit": source_commit(),
        "date": time.strftime("%Y-%m-%d"),
        "machine": {
            "system": platform.system(),
            "processor": llvmlite.binding.get_host_cpu_name(),
            "cpus": numba.config.NUMBA_DEFAULT_NUM_THREADS,
            "numba_threads": numba.get_num_threads(),
            "torch_threads": torch.get_num_threads(),
            "omp_wait_policy": os.environ["OMP_WAIT_POLICY"],
        },
        "versions": {name: version(name) for name in names} | {"python": platform.python_version()},
    }


def table(measured: list[Row], notes: dict[Row, str] | None = None) -> str:
    width = max((len(row.stage) for row in measured), default=0)
    lines = [f"{'stage':{width}}  {'size':>17}  {'ours ms':>9}  {'torch ms':>9}  {'ratio':>7}  {'share':>6}"]
    for row in measured:
        theirs = "" if row.torch_ms is None else f"{row.torch_ms:.2f}"
        ratio = "" if row.ratio is None else f"{row.ratio:.4f}"
        share = "" if row.share is None else f"{row.share:.1%}"
        line = f"{row.stage:{width}}  {row.size:>17}  {row.ours_ms:9.2f}  {theirs:>9}  {ratio:>7}  {share:>6}"
        lines.append(f"{line}  {(notes or {}).get(row, '')}".rstrip())
    return "\n".join(lines)


def threads() -> str:
    """One line that says on how many threads the numbers stand."""
    return f"{numba.get_num_threads()} Numba threads, {torch.get_num_threads()} torch threads"


def save(measured: list[Row], file: Path) -> None:
    """Write facts and rows as JSON."""
    lines = []
    for row in measured:
        values = asdict(row) | {"ratio": row.ratio}
        values |= {name: float(f"{value:.4g}") for name, value in values.items() if isinstance(value, float)}
        lines.append(json.dumps(values))
    head = json.dumps(facts(), indent=2).removesuffix("\n}")
    file.write_text(f'{head},\n  "rows": [\n    ' + ",\n    ".join(lines) + "\n  ]\n}\n", encoding="utf-8")


def arguments(about: str | None) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="20,000 Gaussians at 640x512 only")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results there")
    parser.add_argument("--threads", type=int, help="of Numba and of torch; default: what they choose")
    return parser


def set_threads(count: int | None) -> None:
    if count:
        numba.set_num_threads(count)
        torch.set_num_threads(count)


def sizes(options: argparse.Namespace) -> tuple[Size, ...]:
    return QUICK if options.quick else FULL


def report(measured: list[Row], options: argparse.Namespace, notes: dict[Row, str] | None = None) -> None:
    print(f"{threads()}\n{table(measured, notes)}")
    if options.json:
        save(measured, options.json)
