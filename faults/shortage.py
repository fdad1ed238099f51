"""Too little memory, or a disk that is full: one line, nothing partial, nothing lost; with more, the run resumes."""

from __future__ import annotations

import resource
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from harness import Program, Row, demand, differences, digest, leftovers, run, small_sequence, training

LIMITS_MB = (200, 500, 600, 700, 800, 900, 1000, 1300)
"""Of what the process may write to (`ulimit -d`), which counts stacks of threads and buffers that are never touched."""
SMALL_BYTES = 100_000
"""A limit for files that no checkpoint fits into."""


def memory(work: Path) -> list[Row]:
    """Train under each limit in turn, every time going on where the last one ended; then without a limit."""
    data, whole, parts = work / "data", work / "whole_memory", work / "parts_memory"
    if not data.exists():
        small_sequence(data)
    demand(run(*training(data, whole, 300)))
    rows = []
    for megabytes in LIMITS_MB:
        resume = ["--resume"] if (parts / "config.json").exists() else []
        done = run(*training(data, parts, 300), *resume, limits={resource.RLIMIT_DATA: megabytes * 2**20})
        passed = (done.status == 0 or done.one_line) and not leftovers(parts)
        rows.append(Row("memory", f"at most {megabytes} MB", "done" if done.status == 0 else done.in_words, passed))
    demand(run(*training(data, parts, 300), "--resume"))
    different = differences(parts, whole)
    rows.append(Row("memory", "... files that differ in the end", ", ".join(different) or "none", not different))
    return rows


def file_limit(work: Path) -> list[Row]:
    """A limit on the size of files, which every system has: the next checkpoint does not fit."""
    data, whole, parts = work / "data", work / "whole", work / "limited"
    if not (whole / "scene.safetensors").exists():
        demand(run(*training(data, whole, 400)))
    demand(run(*training(data, parts, 400), "--schedule.fine-iterations", 400, "--checkpoint-seconds", 0.5))
    (parts / "scene.safetensors").unlink()
    rows = _stopped("training at a limit for files", data, parts, parts, {resource.RLIMIT_FSIZE: SMALL_BYTES})
    return [*rows, _resumed(data, parts, whole)]


def _stopped(what: str, data: Path, parts: Path, clean: Path, limits: dict[int, int] | None = None) -> list[Row]:
    """Resume a training that runs out of room; below `clean` nothing partial may stay."""
    before = digest(parts / "checkpoint.safetensors")
    done = run(*training(data, parts, 400), "--resume", limits=limits)
    kept = digest(parts / "checkpoint.safetensors") == before and not leftovers(clean)
    return [
        Row("disk", f"{what}: one line, exit 2", done.in_words, done.one_line),
        Row("disk", "... the last checkpoint is whole, nothing partial", "yes" if kept else "no", kept),
    ]


def _resumed(data: Path, parts: Path, whole: Path) -> Row:
    demand(run(*training(data, parts, 400), "--resume"))
    different = differences(parts, whole)
    told = ", ".join(different) + " differ" if different else "yes"
    return Row("disk", "... after more room: the same bits", told, not different)


def full_disk(work: Path) -> list[Row]:
    """A disk of 64 MB, filled to the last 100 KB; skipped where none can be mounted."""
    disk = work / "disk"
    disk.mkdir()
    with _mounted(disk, "64m") as mounted:
        if not mounted:
            return [Row("disk", "full disk", "not run: mounting a small one needs root", True)]
        data, trained = work / "data", work / "whole"
        parts = disk / "run"
        _train_until_checkpoint(data, parts)
        _fill(disk / "ballast", 100_000)
        rows = _stopped("full while training", data, parts, disk)
        for words in _writers(data, trained, disk):
            done = run(*words)
            clean = done.one_line and not leftovers(disk)
            rows.append(
                Row("disk", f"full: {words[0]} {words[-1] if words[0] == 'export' else ''}", done.in_words, clean)
            )
        (disk / "ballast").unlink()
        rows.append(_resumed(data, parts, trained))
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
    program = Program(*training(data, parts, 400), "--checkpoint-seconds", "0.3")
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


def disk(work: Path) -> list[Row]:
    """Run the tests in the folder `work`."""
    if not (work / "data").exists():
        small_sequence(work / "data")
    return file_limit(work) + full_disk(work)
