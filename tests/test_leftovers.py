"""Temporary files of killed processes go; files of users, and of processes that may live, stay."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from tiny_training import tiny_config

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.runs.train import train
from endoprior.system.atomic import remove_leftovers, temporary_sibling

ENDED = 2**22 - 3
"""Beyond what Linux gives to processes."""


def of_process(path: Path, process: int = ENDED, machine: str = r"\1") -> Path:
    """The temporary sibling that another process uses."""
    own = temporary_sibling(path)
    return own.with_name(re.sub(rf"-([0-9a-f]+)-{os.getpid()}\.", rf"-{machine}-{process}.", own.name))


def foreign_files(folder: Path) -> list[str]:
    """Write what must stay; returns the names, sorted."""
    folder.mkdir(exist_ok=True)
    (folder / ".thesis.2024.partial.tex").write_text("my work")
    (folder / ".backup.2023.partial").mkdir()
    (folder / f".scan.{ENDED}.partial.png").touch()
    temporary_sibling(folder / "scene.safetensors").touch()
    of_process(folder / "scene.safetensors", machine="0" * 12).touch()  # another machine, boot or container
    of_process(folder / "depth").symlink_to(folder / ".backup.2023.partial")
    of_process(folder / "a.png").symlink_to(folder / ".thesis.2024.partial.tex")
    return sorted(path.name for path in folder.iterdir())


def test_only_what_a_dead_process_of_this_machine_left_is_removed(tmp_path):
    kept = foreign_files(tmp_path)
    for name in ("checkpoint.safetensors", "v1.2", "config"):
        of_process(tmp_path / name).touch()
    partial = of_process(tmp_path / "checkpoint.safetensors")
    partial.with_name(f"{partial.name}.staging").touch()  # of the library that writes tensors
    of_process(tmp_path / "frames").mkdir()
    (of_process(tmp_path / "frames") / "link").symlink_to(tmp_path / ".backup.2023.partial")
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == kept


def test_a_rejected_training_removes_nothing(tiny_sequence, tmp_path, capsys):
    out = tmp_path / "out"
    foreign_files(out)
    of_process(out / "checkpoint.safetensors").touch()
    before = sorted(out.iterdir())
    assert main(["train", str(tiny_sequence), str(out), "--no-networks"]) == 2
    assert sorted(out.iterdir()) == before and "one with files in it" in capsys.readouterr().err
    with pytest.raises(InputError, match="a run to resume"):
        train(load_sequence(tiny_sequence), tiny_config("basis"), out, resume=True)
    assert sorted(path for path in out.iterdir() if path.name != ".lock") == before


def test_an_accepted_training_removes_what_a_killed_one_left(tiny_sequence, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    left = of_process(out / "config.json")  # killed before there was anything to resume
    left.touch()
    train(load_sequence(tiny_sequence), tiny_config("basis"), out)
    assert not left.exists() and (out / "scene.safetensors").is_file()
