"""One broken or hostile input: how it is made, the command that meets it, and what must come of it."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import shutil
import stat
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1] / "tests"


class Samples:
    """Sound inputs that cases damage copies of; each is made when it is first needed."""

    def __init__(self, folder: Path) -> None:
        """Args: folder: where they are kept, outside of all cases."""
        self.folder = folder

    @cached_property
    def sequence(self) -> Path:
        """17 frames of 48x40 px in the EndoNeRF layout."""
        sys.path.insert(0, str(TESTS))
        from conftest import write_tiny_sequence

        return write_tiny_sequence(self.folder / "sequence")

    @cached_property
    def run(self) -> Path:
        from endoprior.cli import main

        options = "--init-budget 200 --schedule.coarse-iterations 1 --schedule.fine-iterations 3 --no-networks"
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            assert main(["train", str(self.sequence), str(self.folder / "run"), *options.split()]) == 0
        return self.folder / "run"

    @cached_property
    def video(self) -> Path:
        """Ten pictures of 96x80 px, losslessly compressed."""
        sys.path.insert(0, str(TESTS))
        import cv2
        import numpy as np
        from video_files import write_video

        rng = np.random.default_rng(0)
        texture = cv2.resize(rng.integers(40, 200, (10, 16, 3), dtype=np.uint8), (110, 100)) // (1, 2, 2)
        pictures = [texture[i : i + 80, i : i + 96].astype(np.uint8) for i in range(10)]
        return write_video(self.folder / "clip.mkv", pictures)

    def copy(self, name: str, target: Path) -> Path:
        source: Path = getattr(self, name)
        if source.is_dir():
            shutil.copytree(source, target)
        else:
            shutil.copy(source, target)
        return target


Step = Callable[[Path], object]
"""Makes or damages something below a folder."""
Build = Callable[[Path, Samples], list[str]]
"""Makes the input in a folder, which is the command's working folder, and returns the command's arguments."""


def given(command: str | list[str], *steps: Step, needs: str = "") -> Build:
    """A command after some steps in its working folder; a string is split at spaces.

    Args:
        needs: names of samples that are copied first: `sequence` to `data`, `run` to `run`, `video` to `clip.mkv`.
    """

    def build(folder: Path, samples: Samples) -> list[str]:
        for name in needs.split():
            samples.copy(name, folder / {"sequence": "data", "run": "run", "video": "clip.mkv"}[name])
        for step in steps:
            step(folder)
        return command.split() if isinstance(command, str) else command

    return build


@dataclass(frozen=True)
class Case:
    """One input with its verdict."""

    name: str
    build: Build
    says: tuple[str, ...] = ()
    """Words of the one line of the refusal, the file's or the option's name among them; none if it must work."""
    leaves: tuple[str, ...] = ()
    """What the command may add to its working folder: the beginnings of relative paths."""
    check: Callable[[Path], bool] = field(default=lambda folder: True)
    """Whether what it left is right, for cases that work."""
    noise: str = ""
    """What a library in C writes to stderr before it can be stopped."""
    needs_user: bool = False
    """Means nothing to the superuser, whom no permission stops."""


def snapshot(folder: Path) -> dict[str, str]:
    """State of everything below a folder, by relative path; nothing but regular files is opened."""
    found = {}
    for place, folders, files in os.walk(folder, onerror=lambda error: None):
        for name in (*folders, *files):
            path = Path(place, name)
            mode = path.lstat().st_mode
            state = oct(mode)
            if stat.S_ISLNK(mode):
                state += os.readlink(path)
            elif stat.S_ISREG(mode) and os.access(path, os.R_OK):
                state += hashlib.sha256(path.read_bytes()).hexdigest()
            found[os.fsdecode(os.fsencode(path.relative_to(folder)))] = state
    return found


def complaints(case: Case, status: int, errors: str, before: dict[str, str], after: dict[str, str]) -> list[str]:
    """What is wrong with how a command ended; nothing if all is as it must be.

    Args:
        status: its exit status.
        errors: what it wrote to stderr.
        before, after: `snapshot` of the folder above its working folder.
    """
    wrong = []
    lines = [line for line in errors.splitlines() if not (case.noise and case.noise in line)]
    if status != (2 if case.says else 0):
        wrong.append(f"exit status {status}")
    if "Traceback" in errors:
        wrong.append("a traceback")
    if case.says and (len(lines) != 1 or not lines[0].startswith("endoprior: ")):
        wrong.append(f"{len(lines)} lines on stderr")
    if not errors.replace("\n", "").isprintable():
        wrong.append("control characters on stderr")
    if case.says and errors.count("Fix: ") != 1:
        wrong.append(f"{errors.count('Fix: ')} fixes")
    if missing := [word for word in case.says if word not in errors]:
        wrong.append(f"no word of {missing}")
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    if odd := [
        name for name in changed if not name.startswith(tuple(f"work/{start}" for start in case.leaves or "\0"))
    ]:
        wrong.append(f"touched {odd[:3]}")
    return wrong
