"""`endoprior batch LIST OUT`."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import input_error
from ..system.console import say
from .arguments import Help, parse
from .step_display import StepDisplay

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from ..pipeline import Entry, Outcome
    from ..prepare.pipeline import Progress


@dataclass
class Batch:
    """Many videos and sequence folders, one after the other or on a Ray cluster: each as `endoprior run` does one.

    LIST has a line for each: `[NAME =] PATH [OPTIONS]`, with options of `endoprior run` for a video and of `endoprior
    train` for a sequence folder. OUT gets a folder for each, and a table: summary.md, scores.csv. One that fails does
    not stop the others. To resume, or to try again what failed, run the same command again.
    """

    list: Path = field(metadata={"place": "LIST"})
    """Text file."""
    out: Path = field(metadata={"place": "OUT"})
    """Folder for the results."""
    ray: str | None = None
    """Train on a Ray cluster that shares this file system: its address, `auto`, or `local`, which starts one."""


HELP = Help(examples=(("LIST", "OUT"), ("LIST", "OUT", "--ray", "auto")))


def run(argv: list[str]) -> int:
    """Do every job of the list and write the table; 1 if one failed."""
    args = parse(Batch, argv, "batch", HELP)
    from ..pipeline import SUMMARY, TABLE, run_here, run_on, write_summary
    from ..runs import kernel_cache
    from ..runs.folder import LOCK
    from ..system.file_lock import locked
    from ..system.ray_cluster import connected
    from .batch_list import entries_of
    from .output_paths import require_writable_folder

    entries = entries_of(args.list, args.out, cache(say))
    require_writable_folder("OUT", args.out)
    waiting = [entry for entry in entries if not entry.is_done]
    say(f"{args.list}: {len(entries)} jobs, {len(entries) - len(waiting)} done before")
    for entry in waiting:
        kernel_cache.fill(entry.job.cfg, say)
    outcomes = []
    with connected(args.ray, say) if args.ray and waiting else nullcontext() as cluster:
        try:
            args.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise input_error(args.out, "a place for a folder", f"{error.strerror}", "choose another folder.") from None
        with locked(args.out, args.out / LOCK):
            try:
                for outcome in run_on(cluster, entries, say) if cluster else run_here(entries, _shown):
                    _tell(outcome)
                    outcomes.append(outcome)
            except KeyboardInterrupt:
                say("Stopped. To resume, run the same command again.")
                raise
            outcomes.sort(key=lambda outcome: entries.index(outcome.entry))
            lines = write_summary(outcomes, args.out)
    say("")
    for line in lines:
        say(line)
    say(f"\nThis table: {args.out / SUMMARY}; all scores: {args.out / TABLE}")
    return 1 if any(outcome.failure for outcome in outcomes) else 0


def _shown(entry: Entry, step: str) -> AbstractContextManager[Progress]:
    """The progress of a step of a job in this process."""
    from ..pipeline import steps_of

    names = [f"{entry.name}: {each.name}" for each in steps_of(entry.job)]
    return StepDisplay(names, {}).step(f"{entry.name}: {step}")


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
