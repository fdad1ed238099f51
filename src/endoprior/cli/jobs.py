"""Many jobs one after the other, or on a Ray cluster, with their progress and their table."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from ..system.console import say
from .paths import require_writable_folder
from .progress import Counting, step_progress

if TYPE_CHECKING:
    from ..pipeline import Entry, Outcome


def do_all(entries: Sequence[Entry], out: Path, title: str, ray: str | None = None) -> int:
    """Do jobs one after the other, or on a Ray cluster, and write their table into `out`; 1 if one failed."""
    from ..pipeline import SUMMARY, TABLE, run_here, run_on, write_summary
    from ..runs import kernel_cache
    from ..runs.folder import LOCK
    from ..system.file_lock import locked
    from ..system.ray_cluster import connected

    require_writable_folder("OUT", out)
    waiting = [entry for entry in entries if not entry.is_done]
    say(f"{title}: {len(entries)} jobs, {len(entries) - len(waiting)} done before")
    for entry in waiting:
        kernel_cache.fill(entry.job.cfg, say)
    outcomes = []
    with connected(ray, say) if ray and waiting else nullcontext() as cluster:
        out.mkdir(parents=True, exist_ok=True)
        with locked(out, out / LOCK):
            try:
                for outcome in run_on(cluster, entries, say) if cluster else run_here(entries, _shown):
                    _tell(outcome)
                    outcomes.append(outcome)
            except KeyboardInterrupt:
                say("Stopped. To resume, run the same command again.")
                raise
            outcomes.sort(key=lambda outcome: entries.index(outcome.entry))
            lines = write_summary(outcomes, out)
    for line in ("", *lines, f"\nThis table: {out / SUMMARY}; all scores: {out / TABLE}"):
        say(line)
    return 1 if any(outcome.failure for outcome in outcomes) else 0


def _shown(entry: Entry, step: str) -> AbstractContextManager[Counting]:
    """The progress of a step of a job in this process."""
    from ..pipeline import steps_of

    names = [f"{entry.name}: {each.name}" for each in steps_of(entry.job)]
    return step_progress(names, f"{entry.name}: {step}")


def _tell(outcome: Outcome) -> None:
    """Say how a job ended, with the notes of its steps."""
    from ..pipeline import notes_of, steps_of

    entry = outcome.entry
    if outcome.failure:
        say(f"{entry.name}: failed: {outcome.failure}")
        return
    say(f"{entry.name}: done: {entry.job.out}")
    for step in steps_of(entry.job):
        for line in notes_of(step, entry.job):
            say(f"     {line}")
