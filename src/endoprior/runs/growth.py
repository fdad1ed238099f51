"""What became of the number of Gaussians in a training, by its log."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from .folder import LOG, read_log


@dataclass(frozen=True)
class Growth:
    """Counts of Gaussians, of all windows together."""

    first: int
    """In the first line of the log: before any event, unless one comes within the first iterations."""
    last: int
    num_events: int
    """Events of density control."""
    changes: Counter[str]
    """How many Gaussians were `cloned`, `split` or removed by a rule (`removed_RULE`); 0 for what never happened."""

    @property
    def ratio(self) -> float:
        """Gaussians at the end over those at the start."""
        return self.last / self.first


def growth_of(run: Path) -> Growth | None:
    """The growth in a run folder; None without a log, or where nothing grows, as in a radiance field."""
    log = run / LOG
    if not log.is_file():
        return None
    first: dict[int, int] = {}
    last: dict[int, int] = {}
    num_events, changes = 0, Counter[str]()
    for line in read_log(log, "num_gaussians"):
        window, count = line.get("window", 0), line["num_gaussians"]
        first.setdefault(window, count)
        last[window] = count
        if "event" in line:
            num_events += 1
            changes.update(line["event"])
    total = sum(first.values())
    return Growth(total, sum(last.values()), num_events, changes) if total else None
