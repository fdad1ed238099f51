"""The corpus of broken and hostile inputs, in this process; `python faults/corpus.py` gives each one of its own."""

from __future__ import annotations

import os
import resource
import signal
import sys
from pathlib import Path

import pytest

from endoprior.cli import main

sys.path.insert(0, str(Path(__file__).parents[1] / "faults"))
from corpus import CASES, run_case
from corpus_case import Case, Samples, complaints, snapshot

QUICK = [case for case in CASES if not case.heavy]
AS_PROCESSES = ("a pipe for a picture", "a shape of terabytes", "a decompression bomb", "YAML aliases that explode")
STATM = Path("/proc/self/statm")
SECONDS, MORE_BYTES = 60, 3 << 30
"""What a case may take in this process, before it counts as one that hangs or takes all memory."""


@pytest.fixture(scope="module")
def samples(tmp_path_factory) -> Samples:
    """Sound inputs, made once, and before the clock of any case runs: the first run after installation compiles."""
    made = Samples(tmp_path_factory.mktemp("samples"))
    assert made.sequence.is_dir() and made.run.is_dir() and made.video.is_file()
    return made


@pytest.fixture
def limits():
    """Bound time and address space of this process while a test runs."""

    def stop(signum, frame):
        raise TimeoutError(f"no end after {SECONDS} s")

    handler, before = signal.signal(signal.SIGALRM, stop), resource.getrlimit(resource.RLIMIT_AS)
    if STATM.exists():  # elsewhere a bound of address space means little
        bytes_now = int(STATM.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (bytes_now + MORE_BYTES, before[1]))
    signal.alarm(SECONDS)
    yield
    signal.alarm(0)
    resource.setrlimit(resource.RLIMIT_AS, before)
    signal.signal(signal.SIGALRM, handler)


def test_names_are_unique_and_there_are_many():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names) >= 90


@pytest.mark.parametrize("case", QUICK, ids=lambda case: case.name)
def test_a_bad_input_is_refused_or_works(case: Case, samples: Samples, limits, tmp_path, monkeypatch, capfd):
    if case.needs_user and os.geteuid() == 0:
        pytest.skip("nothing is closed to the superuser")
    work = tmp_path / "case" / "work"
    work.mkdir(parents=True)
    argv = case.build(work, samples)
    before = snapshot(work.parent)
    monkeypatch.chdir(work)
    capfd.readouterr()
    status = main(argv)
    errors = capfd.readouterr().err
    assert not complaints(case, status, errors, before, snapshot(work.parent)), errors
    assert case.check(work)


@pytest.mark.parametrize("name", AS_PROCESSES)
def test_as_a_process(name, samples, tmp_path):
    (case,) = [case for case in CASES if case.name == name]
    wrong, _, errors = run_case(case, tmp_path / "case", samples)
    assert not wrong, errors
