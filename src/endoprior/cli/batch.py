"""`endoprior batch LIST OUT`. A line of the list is a job, as it would be typed for one video or sequence folder."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import InputError, input_error
from ..data.load import is_sequence
from ..data.reading import kind_of, read_text
from ..system.console import say
from .arguments import Help, option_name, parse
from .devices import with_device
from .progress import step_progress
from .run import HELP as RUN_HELP
from .run import Run, job_of, require_gaussians
from .train import arguments

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from ..pipeline import Entry, Outcome, SequenceJob
    from ..prepare.pipeline import Progress

NAME = re.compile(r"[^\W_][\w .+-]*")
"""A name of a folder."""
NOT_IN_A_LIST = (
    "--help", "-h", "--help-all", "--networks", "--no-networks", "--weights-dir", "--resume", "--checkpoint-seconds",
    "--ray", "--view", "--view-port",
)  # fmt: skip
"""Options of a single training; a batch does as `endoprior run`."""


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
    from .paths import require_writable_folder

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


@dataclass(frozen=True)
class Line:
    """A line of a list: `[NAME =] PATH [OPTIONS]`."""

    number: int
    name: str
    path: Path
    options: tuple[str, ...]


def read_list(file: Path) -> list[Line]:
    """The jobs in a list; empty lines and what follows a `#` are skipped.

    Raises:
        InputError: the file cannot be read, has no job, or two with one name.
    """
    fix = "write a line `PATH [OPTIONS]` for each video or sequence folder."
    text, lines = read_text(file, "a list of videos and sequence folders", fix), list[Line]()
    for number, written in enumerate(text.splitlines(), 1):
        try:
            words = _words(written)
        except ValueError as error:
            raise input_error(f"{file}, line {number}", "words as in a shell", f"{error}", "correct it.") from None
        if words:
            lines.append(_line(file, number, words))
    if not lines:
        raise input_error(file, "a list of videos and sequence folders", "an empty file", fix)
    first = {line.name: line for line in reversed(lines)}
    for line in lines:
        if (other := first[line.name]) is not line:
            got = f"{line.name!r} in line {other.number}, too"
            raise input_error(f"{file}, line {line.number}", "another name", got, f"`NAME = {line.path}`.")
    return lines


def entries_of(file: Path, out: Path, tell: Callable[[str], None]) -> list[Entry]:
    """The jobs in a list, with results in folders of `out`. Nothing is written.

    Args:
        tell: takes the device that trains, and the reason.
    Raises:
        InputError: the list, or what a line of it names, cannot be used.
    """
    from ..pipeline import Entry

    entries = []
    for line in read_list(file):
        try:
            entries.append(Entry(line.name, _job(line, out / line.name, tell)))
        except InputError as error:
            raise InputError(f"{file}, line {line.number}: {error}") from None
    return entries


def _words(line: str) -> list[str]:
    """The words of a line; on Windows a backslash stands in paths."""
    if os.name != "nt":
        return shlex.split(line, comments=True)
    return [word.strip('"') for word in shlex.split(line, comments=True, posix=False)]


def _line(file: Path, number: int, words: list[str]) -> Line:
    name, rest = (words[0], words[2:]) if words[1:2] == ["="] else (None, words)
    where, fix = f"{file}, line {number}", "write `PATH [OPTIONS]` or `NAME = PATH [OPTIONS]`."
    if not rest or rest[0].startswith("-"):
        raise input_error(where, "a path", rest[0] if rest else "none", fix)
    path = Path(rest[0]).expanduser()
    name = name or (path.name if kind_of(path) == "a folder" else path.stem)
    if not NAME.fullmatch(name):
        raise input_error(where, "a name for a folder: letters, digits, and spaces, dots or dashes", repr(name), fix)
    return Line(number, name, path, tuple(rest[1:]))


def _job(line: Line, out: Path, tell: Callable[[str], None]) -> SequenceJob:
    if kind_of(line.path) == "nothing":
        raise input_error(line.path, "a video or a sequence folder", "nothing", "correct the path.")
    for word in line.options:
        if option_name(word) in NOT_IN_A_LIST:
            raise input_error(word, "options of what to train", "one of a single training", "remove it.")
    argv = [str(line.path), str(out), *line.options]
    if not is_sequence(line.path):
        return job_of(parse(Run, argv, "run", RUN_HELP), tell)
    from ..pipeline import SequenceJob

    args = arguments(argv)
    require_gaussians(args.config, "`train`, `eval` and `render` one after the other.")
    return SequenceJob(line.path, out, with_device(args.config, args.device, tell))
