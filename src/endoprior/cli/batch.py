"""`endoprior batch LIST OUT`. A line of the list is a job, as it would be typed for one video or sequence folder."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import InputError, input_error
from ..data.files import or_neighbor
from ..data.load import is_prepared
from ..data.reading import kind_of, read_text
from ..system.console import say
from .arguments import Command, option_name
from .devices import with_device
from .jobs import do_all
from .run import Run
from .train import Train, require_gaussians

if TYPE_CHECKING:
    from ..pipeline import Entry, SequenceJob

NAME = re.compile(r"[^\W_][\w .+-]*")
"""A name of a folder."""
NOT_IN_A_LIST = set(
    "--help -h --help-all --networks --no-networks --weights-dir --resume --checkpoint-seconds --ray --view "
    "--view-port".split()
)
"""Options of a single training; a batch does as `endoprior run`."""


@dataclass
class Batch(Command):
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

    examples = ("LIST OUT", "LIST OUT --ray auto")

    def execute(self) -> int:
        """Do every job of the list and write the table; 1 if one failed."""
        return do_all(entries_of(self.list, self.out, cache(say)), self.out, str(self.list), self.ray)


def entries_of(file: Path, out: Path, tell: Callable[[str], None]) -> list[Entry]:
    """The jobs in a list, with results in folders of `out`; empty lines and what follows a `#` are skipped.

    Args:
        tell: takes the device that trains, and the reason.
    """
    from ..pipeline import Entry

    fix = "write a line `PATH [OPTIONS]` for each video or sequence folder."
    text, entries, lines = read_text(file, "a list of videos and sequence folders", fix), [], dict[str, int]()
    for number, written in enumerate(text.splitlines(), 1):
        try:
            if not (words := _words(written)):
                continue
            name, path, options = _parts(words)
            if other := lines.setdefault(name, number) - number:
                got = f"{name!r} in line {number + other}, too"
                raise input_error("NAME", "another one", got, f"`NAME = {path}`.")
            entries.append(Entry(name, _job(path, out / name, options, tell)))
        except ValueError as error:
            problem = f"{error}" if isinstance(error, InputError) else f"expected words as in a shell, got {error}"
            raise InputError(f"{file}, line {number}: {problem}") from None
    if not entries:
        raise input_error(file, "a list of videos and sequence folders", "an empty file", fix)
    return entries


def _words(line: str) -> list[str]:
    """The words of a line; on Windows a backslash stands in paths."""
    if os.name != "nt":
        return shlex.split(line, comments=True)
    return [word.strip('"') for word in shlex.split(line, comments=True, posix=False)]


def _parts(words: list[str]) -> tuple[str, Path, list[str]]:
    """Name, path and options of a line `[NAME =] PATH [OPTIONS]`."""
    name, rest = (words[0], words[2:]) if words[1:2] == ["="] else (None, words)
    if not rest or rest[0].startswith("-"):
        fix = "write `PATH [OPTIONS]` or `NAME = PATH [OPTIONS]`."
        raise input_error("PATH", "a video or a folder", rest[0] if rest else "none", fix)
    path = Path(rest[0]).expanduser()
    name = name or (path.name if kind_of(path) == "a folder" else path.stem)
    if not NAME.fullmatch(name):
        want = "a name for a folder: letters, digits, and spaces, dots or dashes"
        raise input_error("NAME", want, repr(name), "write `NAME = PATH [OPTIONS]`.")
    return name, path, rest[1:]


def _job(path: Path, out: Path, options: list[str], tell: Callable[[str], None]) -> SequenceJob:
    if kind_of(path) == "nothing":
        raise input_error(path, "a video or a sequence folder", "nothing", or_neighbor("correct the path.", path))
    if single := [word for word in options if option_name(word) in NOT_IN_A_LIST]:
        raise input_error(single[0], "options of what to train", "one of a single training", "remove it.")
    argv = [str(path), str(out), *options]
    if not is_prepared(path):
        return Run.from_words(argv).job(tell)
    from ..pipeline import SequenceJob

    train = Train.from_words(argv)
    require_gaussians(train.config, "`train`, `eval` and `render` one after the other.")
    return SequenceJob(path, out, with_device(train.config, train.device, tell))
