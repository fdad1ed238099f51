"""Many jobs: one after the other in this process, or on a Ray cluster. A job that fails does not stop the others."""

from __future__ import annotations

import csv
import io
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from ..core.checks import InputError
from ..data import load_sequence
from ..evaluation.context import read_scores
from ..evaluation.registry import all_scores
from ..prepare.pipeline import Progress
from ..render import ON_GPU
from ..runs.remote import RESTARTS, Training, start_training_on, trainings
from ..runs.train import WindowedRun
from ..system.atomic import write_text
from ..system.devices import Threads
from ..system.ray_cluster import Cluster
from .job import SequenceJob, open_folder
from .steps import SHOWN_SCORES, HandedOn, run_step, start_training, steps_of, verdict_of

FAILURE = "failure.txt"  # in the folder of a job: the traceback, if it failed by an error of the program
SUMMARY, TABLE = "summary.md", "scores.csv"
"""Files in the folder of a batch: the main scores to read, and all scores as numbers."""
BEGIN, FINISH = "before training", "after training"  # calls of a job on a cluster; between them are those that train


@dataclass(frozen=True)
class Entry:
    """A job of a list."""

    name: str  # of its folder
    job: SequenceJob

    @property
    def is_done(self) -> bool:
        """Whether every step has its result."""
        return all(step.result(self.job).exists() for step in steps_of(self.job))


@dataclass(frozen=True)
class Outcome:
    """How a job ended."""

    entry: Entry
    failure: str = ""  # why it failed, one line; empty if it is done


@dataclass(frozen=True)
class Call:
    """A call of a job on a cluster; messages call it `name: what`."""

    entry: Entry
    what: str

    def __str__(self) -> str:
        return f"{self.entry.name}: {self.what}"


def run_here(
    entries: Sequence[Entry], shown: Callable[[Entry, str], AbstractContextManager[Progress]]
) -> Iterator[Outcome]:
    """Do all jobs in this process, in order, and yield how each ended. Args: shown: shows the progress of a step."""
    for entry in entries:
        try:
            _open(entry)
            handed_on = HandedOn()
            for step in steps_of(entry.job):
                if not step.result(entry.job).exists():
                    with shown(entry, step.name) as progress:
                        run_step(step, entry.job, progress, handed_on)
        except Exception as error:
            yield Outcome(entry, _reason(entry, error))
        else:
            yield Outcome(entry)


def run_on(cluster: Cluster, entries: Sequence[Entry], say: Callable[[str], None]) -> Iterator[Outcome]:
    """Do all jobs on a cluster, and yield how each ended. Windows of all sequences train at the same time."""
    threads, left, failures = Threads.of_this_process(), Counter[str](), dict[str, str]()

    def start(entry: Entry, what: str, function: Callable[..., object], cores: int) -> None:
        on_gpu, mine = entry.job.cfg.render.backend in ON_GPU, Threads(cores, threads.torch)
        left[entry.name] += 1
        cluster.start(Call(entry, what), function, entry.job, mine, cores=cores, on_gpu=on_gpu, restarts=RESTARTS)

    for entry in entries:
        if outcome := _opened(entry):
            yield outcome
        else:
            start(entry, BEGIN, begin, cluster.cores_for(len(entries)))
    while cluster.num_running:
        ended = cluster.next()
        entry, what = ended.key.entry, ended.key.what
        trainings_left = ended.value if what == BEGIN and ended.error is None else []
        cores = cluster.cores_for(max(cluster.num_running + len(trainings_left), 1))
        left[entry.name] += len(trainings_left) - 1
        if ended.error is not None:
            failures.setdefault(entry.name, _reason(entry, ended.error))
        elif what != FINISH:
            checked = f"{entry.name}: checked; left to train: {len(trainings_left)}"
            say(checked if what == BEGIN else f"{ended.key}: {ended.value}")
        for training in trainings_left:
            start_training_on(cluster, Call(entry, training.name), training, cores)
        if left[entry.name]:
            continue
        if entry.name in failures or what == FINISH:
            yield Outcome(entry, failures.get(entry.name, ""))
        else:
            start(entry, FINISH, finish, cluster.cores_for(cluster.num_running + 1))


def _opened(entry: Entry) -> Outcome | None:
    """How a job ended that cannot begin, or is done."""
    try:
        _open(entry)
    except Exception as error:
        return Outcome(entry, _reason(entry, error))
    return Outcome(entry) if entry.is_done else None


def begin(job: SequenceJob, threads: Threads) -> list[Training]:
    """Do the steps of a job before its training, in this process; what is left to train."""
    threads.use()
    handed_on = HandedOn()
    for step in steps_of(job):
        if step.name == "train":
            break
        run_step(step, job, _quiet, handed_on)
    if step.result(job).exists():
        return []
    run, _ = start_training(job, handed_on.sequence)
    if isinstance(run, WindowedRun):
        with run.opened():
            return trainings(run)
    return trainings(run)


def finish(job: SequenceJob, threads: Threads) -> None:
    """Do the steps of a job that are left, in this process. Windows that are trained are joined by the training."""
    threads.use()
    handed_on = HandedOn()
    for step in steps_of(job):
        run_step(step, job, _quiet, handed_on)


def _quiet(_what: str, _done: int, _total: int) -> None:
    """No progress."""


def _open(entry: Entry) -> None:
    open_folder(entry.job)
    (entry.job.out / FAILURE).unlink(missing_ok=True)


def _reason(entry: Entry, error: Exception) -> str:
    """One line; the traceback of an error of the program is written to the folder of the job, if that can be."""
    line = " ".join(str(error).split())
    if isinstance(error, InputError):
        return line
    file, reason = entry.job.out / FAILURE, f"{type(error).__name__}: {line[:200]}"
    try:
        write_text(file, "".join(traceback.format_exception(error)))
    except (InputError, OSError):
        return reason
    return f"{reason} ({file})"


def write_summary(outcomes: Sequence[Outcome], out: Path) -> list[str]:
    """Write the table of a batch to `SUMMARY` and `TABLE` in `out`; the lines of `SUMMARY`."""
    done = [outcome.entry for outcome in outcomes if not outcome.failure]
    scores = {entry.name: read_scores(entry.job.run / "metrics.json")["scores"] for entry in done}
    known = [all_scores()[name] for name in SHOWN_SCORES if any(name in found for found in scores.values())]
    lines = []
    if done:
        lines = [f"| | verdict | {' | '.join(score.label for score in known)} |", f"|---|---|{'---|' * len(known)}"]
    for entry in done:
        relative, found = load_sequence(entry.job.data, entry.job.cfg.data).depth_is_relative, scores[entry.name]
        cells = [score.text(found[score.name], relative) if score.name in found else "" for score in known]
        verdict = verdict_of(entry.job)
        lines.append(f"| {entry.name} | {verdict.word if verdict else ''} | {' | '.join(cells)} |")
    if failed := [outcome for outcome in outcomes if outcome.failure]:
        lines += ([""] if done else []) + ["Failed:", ""]
        lines += [f"- {outcome.entry.name}: {outcome.failure}" for outcome in failed]
    write_text(out / SUMMARY, "\n".join(lines) + "\n")
    columns = list(dict.fromkeys(name for found in scores.values() for name in found))
    text = io.StringIO()
    writer = csv.DictWriter(text, ["name", *columns], lineterminator="\n")
    writer.writeheader()
    writer.writerows({"name": name} | found for name, found in scores.items())
    write_text(out / TABLE, text.getvalue())
    return lines
