"""Do the steps of one job with its progress, or many jobs one after the other or on a Ray cluster, with a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from ..system.console import asks_for_action, say
from .paths import require_writable_folder
from .progress import Counting, duration, step_head, step_progress

if TYPE_CHECKING:
    from ..pipeline import Entry, Outcome, SequenceJob


def do_job(job: SequenceJob, *, resumes: bool, verbose: bool) -> None:
    """Say how long it will take, compile kernels if that was not done, and do the steps that are left."""
    from ..pipeline import COMPILE, Forecast, HandedOn, notes_of, parts_of, removed_if_rejected, run_step, steps_of
    from ..runs import kernel_cache

    steps = steps_of(job)
    waiting = [step for step in steps if not step.result(job).exists()]
    names, left = [step.name for step in steps], [step.name for step in waiting]
    if resumes:
        say(resume_words(names, left))
    if waiting and not kernel_cache.is_filled(job.cfg):
        names, left = [COMPILE, *names], [COMPILE, *left]
    forecast, handed_on = Forecast(parts_of(job, left)), HandedOn()
    if waiting:
        say(f"about {duration(forecast.left())} in all")

    def shown(name: str) -> AbstractContextManager[Counting]:
        forecast.begin(name)
        return step_progress(names, name, lambda *news: forecast.after(name, *news))

    with _told_how_to_resume(), removed_if_rejected(job):
        if COMPILE in left:
            with shown(COMPILE) as progress:
                kernel_cache.fill(job.cfg, progress=lambda *done: progress("kernels, once", *done))
        for step in steps:
            if step in waiting:
                with shown(step.name) as progress:
                    notes = run_step(step, job, progress, handed_on)
            else:
                say(f"{step_head(names, step.name):<13} done before")
                notes = notes_of(step, job)
            _say_notes(notes or [], verbose=verbose)


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
            with _told_how_to_resume():
                for outcome in run_on(cluster, entries, say) if cluster else run_here(entries, _shown):
                    _say_outcome(outcome)
                    outcomes.append(outcome)
            outcomes.sort(key=lambda outcome: entries.index(outcome.entry))
            lines = write_summary(outcomes, out)
    for line in ("", *lines, f"\nThis table: {out / SUMMARY}; all scores: {out / TABLE}"):
        say(line)
    return 1 if any(outcome.failure for outcome in outcomes) else 0


def resume_words(names: list[str], waiting: list[str]) -> str:
    """Where a job goes on, and what is there already."""
    done = ", ".join(name for name in names if name not in waiting) or "nothing"
    return f"Resuming at {waiting[0]}; done before: {done}." if waiting else f"All done before: {done}."


def shown_lines(lines: Iterable[str], *, verbose: bool) -> list[str]:
    """Of the lines of a step those to print: `verbose`, or all but the notes that ask for no action."""
    return [line for line in lines if verbose or asks_for_action(line)]


@contextmanager
def _told_how_to_resume() -> Iterator[None]:
    """Where the user stops what is done within, say what to type to resume."""
    try:
        yield
    except KeyboardInterrupt:
        say("Stopped. To resume, run the same command again.")
        raise


def _say_notes(notes: Iterable[str], *, verbose: bool) -> None:
    for line in shown_lines(notes, verbose=verbose):
        say(f"     {line}")


def _shown(entry: Entry, step: str) -> AbstractContextManager[Counting]:
    """The progress of a step of a job in this process."""
    from ..pipeline import steps_of

    names = [f"{entry.name}: {each.name}" for each in steps_of(entry.job)]
    return step_progress(names, f"{entry.name}: {step}")


def _say_outcome(outcome: Outcome) -> None:
    """Say how a job ended, with the notes of its steps."""
    from ..pipeline import notes_of, steps_of

    entry = outcome.entry
    if outcome.failure:
        say(f"{entry.name}: failed: {outcome.failure}")
        return
    say(f"{entry.name}: done: {entry.job.out}")
    for step in steps_of(entry.job):
        _say_notes(notes_of(step, entry.job), verbose=False)
