"""Printed commands can be pasted into the shell."""

import ast
import ntpath
import os
import re
import subprocess
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

from endoprior.core import shell
from endoprior.core.checks import InputError
from endoprior.model.scene_file import load_scene

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


@pytest.fixture
def windows(monkeypatch):
    """Commands are printed as on Windows; everything else stays."""
    system = SimpleNamespace(name="nt", path=ntpath, curdir=os.curdir, fspath=os.fspath)
    monkeypatch.setattr(shell, "os", system)


@pytest.mark.parametrize(
    ("word", "text"),
    [
        (r"C:\data\clip", r"C:\data\clip"),
        (r"C:\Übung Fall 7", r'"C:\Übung Fall 7"'),
        ("a&b", '"a&b"'),
        ("C:\\my data\\", '"C:\\my data\\\\"'),
    ],
)
def test_windows_takes_double_quotes(windows, word, text):
    assert shell.quoted(word) == text


def test_hints_name_paths_as_windows_reads_them(windows):
    assert shell.command("check", Path("-x")) == r"endoprior check .\-x"
    with pytest.raises(InputError, match='`endoprior train DATA "my run"`'):
        load_scene(Path("my run"))


def test_commands_with_values_are_built_by_the_function():
    """So that the tests above hold for all of them."""
    source = Path(shell.__file__).parents[1]
    for path in source.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for part, value in pairwise(node.values) if isinstance(node, ast.JoinedStr) else ():
                if isinstance(part, ast.Constant) and isinstance(value, ast.FormattedValue):
                    begun = re.search(r"endoprior [a-z]+ [^`;,]*$", part.value)
                    assert not begun, f"{path}:{node.lineno}: use core.shell.command for {begun and begun[0]}..."
