"""Broken and hostile inputs for the command line. The cases are in `faults/corpus_*.py`."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from endoprior.cli import main

sys.path.insert(0, str(Path(__file__).parents[1] / "faults"))
from corpus import CASES, KINDS
from corpus_case import Case, Samples, complaints, snapshot

SAMPLE = (
    *("no folder", "a picture cut short", "a mask of 0 and 1", "NaN in a pose", "poses in a pickle"),
    *("a focal length in words", "a text called .mp4", "a video of one picture", "YAML that executes"),
    *("poses of another clip", "no such option", "check --data.shrink 0", "prior into a file", "phantom --width 0"),
    *("a scene of noise", "a config that is not JSON", "a checkpoint cut short", "a camera path of words"),
    *("an empty spec", "a preset nobody knows", "a pipe for a picture", "a video of odd size"),
    *("settings of Numba beside the data", "a name with a fix of its own"),
)
"""One case of each way to go wrong, and two in which the command must work or must not wait."""
AS_PROCESSES = (
    *("a pipe for a picture", "a shape of terabytes", "a decompression bomb", "YAML aliases that explode"),
    *("json.py beside the data", "tomllib.py beside the data", "settings of Matplotlib beside the data"),
)
STATM = Path("/proc/self/statm")
SECONDS, MORE_BYTES = 60, 3 << 30
"""What a case may take in this process, before it counts as one that hangs or takes all memory."""
PROCESS_BYTES, FILE_BYTES = 6 << 30, 1 << 30
"""Limits of a process of its own: address space, and each file it writes."""


@pytest.fixture(scope="module")
def samples(tmp_path_factory) -> Samples:
    """Sound inputs, made before the clock of any case runs: the first training compiles kernels."""
    made = Samples(tmp_path_factory.mktemp("samples"))
    assert made.sequence.is_dir() and made.run.is_dir() and made.video.is_file()
    return made


@contextmanager
def limits() -> Iterator[None]:
    """Bound time and address space of this process."""

    def stop(signum, frame):
        raise TimeoutError(f"no end after {SECONDS} s")

    handler, before = signal.signal(signal.SIGALRM, stop), resource.getrlimit(resource.RLIMIT_AS)
    if STATM.exists():  # elsewhere a bound of address space means little
        bytes_now = int(STATM.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (bytes_now + MORE_BYTES, before[1]))
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGALRM, handler)


def run_here(argv: list[str], capfd) -> tuple[int, str]:
    """Exit status and stderr of the command line in this process; what it raises counts as a status of 1."""
    capfd.readouterr()
    try:
        with limits():
            status = main(argv)
    except Exception as error:
        return 1, f"Traceback: {error!r}"
    return status, capfd.readouterr().err


def run_as_process(argv: list[str], capfd) -> tuple[int, str]:
    """Exit status and stderr of a process of its own, under limits."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (PROCESS_BYTES, PROCESS_BYTES))
        resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))

    words = [sys.executable, "-m", "endoprior", *argv]
    options = {"stdin": subprocess.DEVNULL, "capture_output": True, "timeout": SECONDS, "preexec_fn": limit}
    done = subprocess.run(words, **options)
    return done.returncode, done.stderr.decode(errors="replace")


def wrong_cases(cases: list[Case], samples: Samples, folder: Path, monkeypatch, capfd, run=run_here) -> list[str]:
    """Build and run each case below `folder`; a line for each that ended otherwise than it must."""
    wrong = []
    for number, case in enumerate(cases):
        if case.needs_user and os.geteuid() == 0:
            continue  # nothing is closed to the superuser
        place = folder / str(number)
        work = place / "work"
        work.mkdir(parents=True)
        monkeypatch.chdir(work)
        argv, before = case.build(work, samples), snapshot(place)
        status, errors = run(argv, capfd)
        found = complaints(case, status, errors, before, snapshot(place))
        if not found and not case.check(work):
            found = ["a wrong result"]
        if found:
            wrong.append(f"{case.name}: {'; '.join(found)}\n    {errors.strip()[-300:]}")
    return wrong


BY_NAME = {case.name: case for case in CASES}


def test_names_are_unique_and_there_are_many():
    assert len(BY_NAME) == len(CASES) >= 400


def test_a_sample_of_bad_inputs_is_rejected_in_one_line(samples, tmp_path, monkeypatch, capfd):
    wrong = wrong_cases([BY_NAME[name] for name in SAMPLE], samples, tmp_path, monkeypatch, capfd)
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_bad_inputs_are_rejected_in_one_line_or_work(kind, samples, tmp_path, monkeypatch, capfd):
    assert not (wrong := wrong_cases(KINDS[kind], samples, tmp_path, monkeypatch, capfd)), "\n".join(wrong)


@pytest.mark.slow
def test_processes_of_their_own_under_limits(samples, tmp_path, monkeypatch, capfd):
    cases = [BY_NAME[name] for name in AS_PROCESSES]
    wrong = wrong_cases(cases, samples, tmp_path, monkeypatch, capfd, run_as_process)
    assert not wrong, "\n".join(wrong)
