"""Memory: long and large sequences are trained within a stated one, or refused with a number; it does not leak.

`python limits.py DATA OUT` trains three times in one process, scores, and prints the memory it has after each, MB.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from harness import ENVIRONMENT, Row, demand, run, small_sequence

LONG_FRAMES, LARGE_FRAMES = 1000, 24
LONG_LIMIT_MB, LARGE_LIMIT_MB = 6000, 6000
CACHE_GB = "0.5"
"""Of each cache; what they may take otherwise depends on the machine."""
TRAININGS = 3
GROWTH_MB = 30.0
"""Allowed between the first and the last: allocators do not return every page."""
LONG_ITERATIONS, LARGE_ITERATIONS = 200, 40


def long_sequence(source: Path, out: Path, frames: int) -> Path:
    """The frames of `source` played back and forth, as links: what is tested is their number."""
    for name in ("images", "masks", "depth"):
        (out / name).mkdir(parents=True)
        files = sorted((source / name).iterdir())
        there_and_back = files + files[-2:0:-1]
        for i in range(frames):
            os.link(there_and_back[i % len(there_and_back)], out / name / f"{i:06d}.png")
    poses = np.load(source / "poses_bounds.npy")
    np.save(out / "poses_bounds.npy", np.tile(poses[:1], (frames, 1)))
    about = json.loads((source / "sequence.json").read_text(encoding="utf-8"))
    (out / "sequence.json").write_text(json.dumps(about), encoding="utf-8")
    return out


def enlarged(source: Path, out: Path, frames: int, width: int, height: int) -> Path:
    """The first frames of `source` at another size."""
    about = json.loads((source / "sequence.json").read_text(encoding="utf-8"))
    across, down = width / about["width"], height / about["height"]
    for name in ("images", "masks", "depth"):
        (out / name).mkdir(parents=True)
        smooth = cv2.INTER_CUBIC if name == "images" else cv2.INTER_NEAREST
        for file in sorted((source / name).iterdir())[:frames]:
            pixels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(out / name / file.name), cv2.resize(pixels, (width, height), interpolation=smooth))
    about |= {"width": width, "fx": about["fx"] * across, "cx": about["cx"] * across}
    about |= {"height": height, "fy": about["fy"] * down, "cy": about["cy"] * down}
    np.save(out / "poses_bounds.npy", np.load(source / "poses_bounds.npy")[:frames])
    (out / "sequence.json").write_text(json.dumps(about), encoding="utf-8")
    return out


def _few(iterations: int) -> list[object]:
    return ["--schedule.coarse-iterations", 10, "--schedule.fine-iterations", iterations, "--no-networks"]


def _trained(what: str, iterations: int, data: Path, out: Path, limit_mb: float) -> Row:
    done = run("train", data, out, *_few(iterations), timeout=1200, ENDOPRIOR_CACHE_GB=CACHE_GB)
    figure = f"{done.peak_mb / 1000:.1f} GB, {done.seconds:.0f} s" if done.status == 0 else done.in_words
    return Row(
        "limits", f"{what}, {iterations} iterations and scores", figure, done.status == 0 and done.peak_mb < limit_mb
    )


def limits(work: Path) -> list[Row]:
    source = work / "phantom"
    demand(run("phantom", source, "--frames", 48, "--width", 640, "--height", 512))
    long = long_sequence(source, work / "long", LONG_FRAMES)
    what = f"{LONG_FRAMES:,} frames of 640x512, {CACHE_GB} GB a cache"
    rows = [_trained(what, LONG_ITERATIONS, long, work / "long_run", LONG_LIMIT_MB)]
    large = enlarged(source, work / "large", LARGE_FRAMES, 3840, 2160)
    what = f"{LARGE_FRAMES} frames of 3840x2160, {CACHE_GB} GB a cache"
    rows.append(_trained(what, LARGE_ITERATIONS, large, work / "large_run", LARGE_LIMIT_MB))
    done = run("train", large, work / "refused", *_few(1), limits={resource.RLIMIT_DATA: 1500 * 2**20})
    told = done.one_line and "GB" in done.err
    rows.append(Row("limits", "the same with 1.5 GB: refused with a number", done.in_words, told))
    for folder in ("long", "long_run", "large", "large_run"):
        shutil.rmtree(work / folder, ignore_errors=True)
    return rows


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def train_again_and_again(data: Path, out: Path) -> None:
    """What the process does."""
    import endoprior

    changes = {"schedule.coarse_iterations": 50, "schedule.fine_iterations": 300, "init.budget": 4000}
    cfg = endoprior.preset("default").replace(changes)
    for i in range(TRAININGS):
        sequence = endoprior.load_sequence(data)
        scene = endoprior.train(sequence, cfg, out=out / str(i))
        endoprior.evaluate(scene, sequence, networks=False)
        del scene, sequence
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # freed pages that the allocator merely keeps are no leak
        print(f"{resident_mb():.1f}", flush=True)


def soak(work: Path) -> list[Row]:
    data = work / "data"
    if not data.exists():
        small_sequence(data)
    words = [sys.executable, __file__, str(data), str(work / "soak")]
    told = subprocess.run(words, env=ENVIRONMENT, capture_output=True, encoding="utf-8", check=True).stdout
    sizes = [float(line) for line in told.split()[-TRAININGS:]]
    figure = ", ".join(f"{size:.0f}" for size in sizes) + " MB"
    passed = len(sizes) == TRAININGS and sizes[-1] - sizes[0] < GROWTH_MB
    return [Row("soak", f"{TRAININGS} trainings in one process: memory after each", figure, passed)]


if __name__ == "__main__":
    train_again_and_again(Path(sys.argv[1]), Path(sys.argv[2]))
