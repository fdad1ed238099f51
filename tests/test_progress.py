"""Who sees the progress of a training: a terminal, a notebook, whoever asks; a script's log stays clean."""

from __future__ import annotations

import builtins
import errno
import io
import sys
import time
from types import SimpleNamespace

import pytest
from tiny_training import tiny_config

from endoprior.cli.progress import Counting
from endoprior.data import load_sequence
from endoprior.runs.progress import training_progress
from endoprior.runs.train import train
from endoprior.training.trainer import Stage


class Terminal(io.StringIO):
    """Takes what is printed, as a terminal does."""

    def isatty(self) -> bool:
        """It is one."""
        return True


class ClosedTerminal(Terminal):
    """Takes nothing any more."""

    def write(self, text: str) -> int:
        """Fail as a terminal that was closed."""
        raise OSError(errno.EIO, "Input/output error")


def test_a_closed_terminal_does_not_end_the_work(monkeypatch):
    monkeypatch.setattr(sys, "stderr", ClosedTerminal())
    with Counting() as progress:
        progress("frames", 1, 2)


@pytest.fixture
def train_tiny(tiny_sequence):
    """Trains three iterations with a choice of `progress`."""
    return lambda progress: train(load_sequence(tiny_sequence), tiny_config("basis", 1, 2), progress=progress)


@pytest.fixture
def in_notebook(monkeypatch):
    """What rich recognizes a notebook by."""
    shell = type("ZMQInteractiveShell", (), {})
    monkeypatch.setattr(builtins, "get_ipython", shell, raising=False)


@pytest.mark.parametrize("progress", [None, False])
def test_a_log_file_stays_empty(train_tiny, progress, capfd):
    train_tiny(progress)
    assert capfd.readouterr() == ("", "")


def test_a_terminal_shows_a_bar(train_tiny, monkeypatch):
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    train_tiny(None)
    assert "17 frames" in terminal.getvalue() and "3/3" in terminal.getvalue()


def test_a_notebook_shows_one_line(train_tiny, in_notebook, capfd):
    train_tiny(None)
    out, err = capfd.readouterr()
    assert not out and "\rfine 3/3" in err and err.rstrip().endswith("Gaussians")


def test_an_interrupted_line_of_a_notebook_ends(in_notebook, capfd):
    with pytest.raises(KeyboardInterrupt), training_progress():
        raise KeyboardInterrupt
    assert capfd.readouterr().err == "\n"


def test_asked_for_in_a_script_it_is_plain_lines(train_tiny, capfd):
    train_tiny(True)
    out, err = capfd.readouterr()
    assert "fine 3/3" in out and "17 frames" in err


def test_nobody_sees_it_where_it_is_switched_off(train_tiny, monkeypatch):
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    train_tiny(False)
    assert not terminal.getvalue()


def test_the_rate_is_that_of_the_window(capfd):
    """A scene of several windows trains one after the other: preparing the next one is no iteration."""
    color = {"color": 0.1}
    with training_progress() as show:
        for _ in range(2):
            for done in (1, 2):
                report = SimpleNamespace(seconds=0.01, stage=Stage.FINE, terms=color, num_gaussians=3)
                show(report, SimpleNamespace(progress=lambda done=done: (done, 2)))
            time.sleep(0.3)
    rates = [float(line.split()[2]) for line in capfd.readouterr().out.splitlines()]
    assert len(rates) == 2 and min(rates) > 20
