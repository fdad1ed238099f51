"""Printed commands can be pasted into the shell."""

import os
import subprocess
from pathlib import Path

import pytest

from endoprior.core import shell

HARD = ["Übung Fall 7/Daten ä", "it's", "a&b", "$HOME", "plain", "", "two  spaces", 'quote"', "semi;colon", "*"]


@pytest.mark.skipif(os.name == "nt", reason="runs a POSIX shell")
@pytest.mark.parametrize("word", HARD)
def test_the_shell_reads_a_quoted_word_back(word):
    script = f"printf %s {shell.quoted(word)}"
    assert subprocess.run(["sh", "-c", script], capture_output=True, check=True).stdout.decode() == word


def test_a_command_quotes_only_what_needs_it():
    assert shell.command("check", Path("data/clip_1")) == "endoprior check data/clip_1"
    assert shell.command("check", Path("my data")) == "endoprior check 'my data'"


def test_a_path_is_never_read_as_an_option():
    assert shell.command("check", Path("-x")) == "endoprior check ./-x"
    assert shell.command("train", "--resume") == "endoprior train --resume"


@pytest.mark.parametrize(
    ("word", "text"),
    [
        (r"C:\data\clip", r"C:\data\clip"),
        (r"C:\Übung Fall 7", r'"C:\Übung Fall 7"'),
        ("a&b", '"a&b"'),
        ("C:\\my data\\", '"C:\\my data\\\\"'),
    ],
)
def test_windows_takes_double_quotes(monkeypatch, word, text):
    monkeypatch.setattr(shell.os, "name", "nt")
    assert shell.quoted(word) == text
