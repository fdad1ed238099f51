"""Three trainings in a row in one process, scored and exported: memory must not grow.

`python soak.py DATA OUT` is that process; it prints the memory it has resident after each training, MB.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from harness import ENVIRONMENT, Row, small_sequence

TRAININGS = 3
GROWTH_MB = 30.0
"""Allowed between the first and the last: allocators do not return every page."""


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def train_again_and_again(data: Path, out: Path) -> None:
    """What the process does."""
    import ctypes
    import gc

    import endoprior

    changes = {"schedule.coarse_iterations": 50, "schedule.fine_iterations": 300, "init.budget": 4000}
    cfg = endoprior.preset("default").replace(changes)
    for i in range(TRAININGS):
        sequence = endoprior.load_sequence(data)
        scene = endoprior.train(sequence, cfg, out=out / str(i))
        endoprior.evaluate(scene, sequence, networks=False)
        del scene, sequence
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # freed pages that the allocator merely keeps are no leak
        print(f"{resident_mb():.1f}", flush=True)


def main(work: Path) -> list[Row]:
    data = work / "data"
    if not data.exists():
        small_sequence(data)
    words = [sys.executable, __file__, str(data), str(work / "soak")]
    told = subprocess.run(words, env=ENVIRONMENT, capture_output=True, encoding="utf-8", check=True).stdout
    sizes = [float(line) for line in told.split()[-TRAININGS:]]
    figure = ", ".join(f"{size:.0f}" for size in sizes) + " MB"
    passed = len(sizes) == TRAININGS and sizes[-1] - sizes[0] < GROWTH_MB
    return [Row("soak", f"{TRAININGS} trainings in one process: memory after each", figure, passed)]


if __name__ == "__main__":
    train_again_and_again(Path(sys.argv[1]), Path(sys.argv[2]))
