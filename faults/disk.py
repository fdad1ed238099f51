"""A disk that is full: every command that writes refuses in one line, leaves nothing partial, and loses nothing."""

from __future__ import annotations

import resource
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from harness import Row, demand, differences, digest, leftovers, run, small_sequence
from kills import arguments

SMALL_BYTES = 100_000
"""A limit for files that no checkpoint fits into."""


def file_limit(work: Path) -> list[Row]:
    """A limit on the size of files, which every system has: the next checkpoint does not fit."""
    data, whole, parts = work / "data", work / "whole", work / "limited"
    if not (whole / "scene.safetensors").exists():
        demand(run(*arguments(data, whole, 400)))
    demand(run(*arguments(data, parts, 400), "--schedule.fine-iterations", 400, "--checkpoint-seconds", 0.5))
    (parts / "scene.safetensors").unlink()
    before = digest(parts / "checkpoint.safetensors")
    limits = {resource.RLIMIT_FSIZE: SMALL_BYTES}
    done = run(*arguments(data, parts, 400), "--resume", limits=limits)
    kept = digest(parts / "checkpoint.safetensors") == before and not leftovers(parts)
    demand(run(*arguments(data, parts, 400), "--resume"))
    return [
        Row("disk", "training at a limit for files: one line, exit 2", done.in_words, done.one_line),
        Row("disk", "... the last checkpoint is whole, nothing partial", "yes" if kept else "no", kept),
        Row("disk", "... after more room: the same bits", *_verdict(differences(parts, whole))),
    ]


def full_disk(work: Path) -> list[Row]:
    """A disk of 24 MB, filled to the last 100 KB; skipped where none can be mounted."""
    disk = work / "disk"
    disk.mkdir()
    with _mounted(disk, "24m") as mounted:
        if not mounted:
            return [Row("disk", "full disk", "not run: mounting a small one needs root", True)]
        data, trained = work / "data", work / "whole"
        parts = disk / "run"
        _train_until_checkpoint(data, parts)
        before = digest(parts / "checkpoint.safetensors")
        _fill(disk / "ballast", 100_000)
        rows = []
        done = run(*arguments(data, parts, 400), "--resume")
        kept = digest(parts / "checkpoint.safetensors") == before and not leftovers(disk)
        rows.append(Row("disk", "full while training: one line, exit 2", done.in_words, done.one_line))
        rows.append(Row("disk", "... the last checkpoint is whole, nothing partial", "yes" if kept else "no", kept))
        for words in _writers(data, trained, disk):
            done = run(*words)
            clean = done.one_line and not leftovers(disk)
            rows.append(
                Row("disk", f"full: {words[0]} {words[-1] if words[0] == 'export' else ''}", done.in_words, clean)
            )
        (disk / "ballast").unlink()
        demand(run(*arguments(data, parts, 400), "--resume"))
        rows.append(Row("disk", "... after more room: the same bits", *_verdict(differences(parts, trained))))
    return rows


def _writers(data: Path, trained: Path, disk: Path) -> list[tuple[object, ...]]:
    """Commands whose results do not fit into 100 KB."""
    names = {"ply": "tissue", "scene": "tissue.safetensors", "html": "tissue.html", "video": "tissue.mp4"}
    exports = [("export", trained, disk / name, "--format", kind) for kind, name in names.items()]
    return [
        ("phantom", disk / "phantom", "--frames", 8, "--width", 160, "--height", 128),
        ("prepare", data / "images", disk / "prepared", "--layout", "mono"),
        ("prior", data, disk / "prior"),
        ("check", data, "--out", disk / "check.png"),
        ("render", trained, disk / "render"),
        *exports,
    ]


def _train_until_checkpoint(data: Path, parts: Path) -> None:
    """A run on the small disk that was killed after its first checkpoint."""
    from harness import Program

    program = Program(*arguments(data, parts, 400), "--checkpoint-seconds", "0.3")
    while program.running and not (parts / "checkpoint.safetensors").exists():
        pass
    program.kill()
    program.wait()


def _fill(ballast: Path, spare: int) -> None:
    with ballast.open("wb") as file:
        file.write(b"\0" * (shutil.disk_usage(ballast.parent).free - spare))


@contextmanager
def _mounted(folder: Path, size: str) -> Iterator[bool]:
    """A disk of its own in memory; yields whether that was allowed."""
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], capture_output=True, check=False
    )
    try:
        yield mounted.returncode == 0
    finally:
        if mounted.returncode == 0:
            subprocess.run(["umount", str(folder)], check=False)


def _verdict(different: list[str]) -> tuple[str, bool]:
    return (", ".join(different) + " differ" if different else "yes"), not different


def main(work: Path) -> list[Row]:
    """Run the tests in the folder `work`."""
    if not (work / "data").exists():
        small_sequence(work / "data")
    return file_limit(work) + full_disk(work)
