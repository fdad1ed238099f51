"""The GPU backends beside the CPU's and the reference, then their speed: one command, no network.

    python bench/gpu.py [--run RUN] [--data FOLDER] [--wheel gsplat-*.whl] [--out FILE.json]

prints the machine, whether pictures and gradients agree, milliseconds, and a whole training, as a Markdown page for
docs/gpu.md; exit status 1 if a backend does not agree. It needs torch, NumPy, SciPy, Numba, OpenCV and PyYAML, and
this checkout; `--wheel` uses gsplat from a wheel that is not installed. `--dry-run` does the same on the CPU, with the
CPU backend in the GPU's place: it tests this file, not a GPU. `--interpreted` has Triton's kernels interpreted on the
CPU: whether they agree, in some ten minutes, and no more.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import zipfile
from dataclasses import asdict, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

if find_spec("endoprior") is None:  # on a machine that has only the checkout
    sys.path.insert(0, str(Path(__file__).parents[1] / "src"))

import common
import torch
from gpu_parity import SCENES, Contest, Gap, agreement, draw, gap, random_case  # noqa: F401
from gpu_speed import LAPS, SIZES, Lap, speed, timed  # noqa: F401
from gpu_training import FRAMES, HEIGHT, WIDTH, Run, header, runs_of, sequence_at, table

from endoprior.core.checks import InputError

DRY_FRAMES, DRY_ITERATIONS = 9, 6


def machine(contest: Contest) -> dict[str, str]:
    """What must be known to read the numbers."""
    found = {"commit": str(common.source_commit()), "torch": torch.__version__, "date": time.strftime("%Y-%m-%d")}
    if contest.device.type != "cuda":
        return found | {"GPU": "none, on the CPU"}
    major, minor = torch.cuda.get_device_capability(contest.device)
    return found | {
        "GPU": f"{torch.cuda.get_device_name(contest.device)} (compute capability {major}.{minor})",
        "driver": driver(),
        "CUDA of torch": str(torch.version.cuda),
        "gsplat": str(getattr(import_module("gsplat"), "__version__", "unknown")) if find_spec("gsplat") else "none",
        "Triton": str(getattr(import_module("triton"), "__version__", "unknown")) if find_spec("triton") else "none",
    }


def driver() -> str:
    """Version of the GPU driver, as nvidia-smi says."""
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(query, capture_output=True, text=True, check=True, timeout=30).stdout
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return answer.splitlines()[0].strip() if answer.strip() else "unknown"


def page(facts: dict[str, str], first_ms: dict[str, float], gaps: list[Gap], laps: list[Lap], runs: list[Run]) -> str:
    """Markdown for docs/gpu.md."""
    lines = [*header("what", "found"), *(f"| {name} | {value} |" for name, value in facts.items())]
    lines += [f"| first picture by {name}, its build included | {ms / 1e3:.1f} s |" for name, ms in first_ms.items()]
    measures = ("color", "alpha", "depth, mm", "relative", "pixels beyond 1e-3", "gradient", "")
    lines += ["", *header("backend", "scene", "against", *measures)]
    for g in summed(gaps):
        lines.append(
            f"| {g.backend} | {g.scene} | {g.against} | {g.color:.1e} | {g.alpha:.1e} | {g.depth_mm:.1e} "
            f"| {g.depth:.1e} | {g.stray:.4%} | {g.gradient:.1e} ({g.worst}) | {'agrees' if g.agrees else 'DIFFERS'} |"
        )
    lines += ["", *header("backend", "stage, 640x512", "Gaussians", "ms", "pictures/s", "peak memory, MB")]
    for lap in laps:
        numbers = f"{lap.note} |" if lap.ms is None else f"{lap.ms:.3f} | {1e3 * lap.pictures / lap.ms:,.0f}"
        memory = "" if lap.memory_mb is None else f"{lap.memory_mb:,.0f}"
        lines.append(f"| {lap.backend} | {lap.stage} | {lap.gaussians:,} | {numbers} | {memory} |")
    return "\n".join(lines + (["", *table(runs)] if runs else []))


def summed(gaps: list[Gap]) -> list[Gap]:
    """One row for the random scenes of a backend against each other one, the worst of each number; others as is."""
    rows = []
    for backend, against in dict.fromkeys((g.backend, g.against) for g in gaps if g.kind == "random"):
        group = [g for g in gaps if (g.kind, g.backend, g.against) == ("random", backend, against)]
        worst = max(group, key=lambda g: g.gradient)
        most = {n: max(getattr(g, n) for g in group) for n in ("color", "alpha", "depth_mm", "depth", "stray")}
        rows.append(replace(worst, scene=f"random, worst of {len(group)}", **most))
    return rows + [g for g in gaps if g.kind != "random"]


def use_wheel(wheel: Path) -> None:
    """Unpack a wheel beside itself and import from there; gsplat builds its kernels from the sources in it, once."""
    folder = wheel.parent / wheel.stem
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    sys.path.insert(0, str(folder))


def contests(options: argparse.Namespace) -> list[Contest]:
    """Who takes part: what was named, else every backend of the GPU that can be imported."""
    if options.dry_run or options.interpreted:
        return [Contest("triton" if options.interpreted else "cpu", torch.device("cpu"))]
    device = torch.device("cuda", 0)
    libraries = {"cuda": "gsplat", "triton": "triton"}
    names = options.backends or [name for name, library in libraries.items() if find_spec(library)]
    return [Contest(name, device) for name in names]


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, metavar="RUN", help="a trained run folder, compared too")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="sequence to train on (default: a phantom)")
    parser.add_argument("--wheel", type=Path, metavar="FILE", help="gsplat's wheel, if it is not installed")
    parser.add_argument("--out", type=Path, metavar="FILE", help="also write everything as JSON there")
    parser.add_argument("--dry-run", action="store_true", help="on the CPU, with the CPU backend in the GPU's place")
    parser.add_argument("--interpreted", action="store_true", help="Triton's kernels on the CPU: agreement only")
    parser.add_argument("--backends", nargs="+", choices=["cuda", "triton"], help="(default: all that are there)")
    parser.add_argument("--scenes", type=int, default=SCENES, help="random scenes (default %(default)s)")
    parser.add_argument("--gaussians", type=int, nargs="+", help="sizes to time (default 20000 40000 100000)")
    parser.add_argument("--laps", type=int, default=LAPS, help="of each timing (default %(default)s)")
    parser.add_argument("--no-training", action="store_true", help="leave out the training")
    return parser


def main(words: list[str] | None = None) -> int:
    """Compare, time, train, print, write; 1 if a backend does not agree."""
    options = arguments().parse_args(words)
    if options.wheel:
        use_wheel(options.wheel)
    if options.interpreted:
        os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is imported
    if not (options.dry_run or options.interpreted) and not torch.cuda.is_available():
        print("expected a GPU that torch can use; found none. Try `endoprior doctor`, or --dry-run.", file=sys.stderr)
        return 2
    sizes = SIZES if not options.gaussians else tuple(common.Size(num, 640, 512) for num in options.gaussians)
    everyone = contests(options)
    facts, first_ms, gaps, laps, runs = machine(everyone[0]), {}, [], [], []

    def keep() -> None:  # as it grows: the machine may be somebody else's, with a time limit
        if options.out:
            parts = {"gaps": [asdict(g) | {"agrees": g.agrees} for g in gaps], "laps": [asdict(lap) for lap in laps]}
            parts |= {"facts": facts, "first_ms": first_ms, "runs": [asdict(run) for run in runs]}
            options.out.write_text(json.dumps(parts, indent=2) + "\n", "utf-8")

    for contest in everyone:
        began = time.perf_counter()
        try:
            draw(contest.backend, contest.device, random_case(0))
        except InputError as error:  # one that cannot be built here must not keep the others from being measured
            laps.append(Lap(contest.backend, "first picture", 0, note=str(error)))
            continue
        first_ms[contest.backend] = 1e3 * (time.perf_counter() - began)
        gaps += agreement(contest, options.scenes, options.run)
        keep()
        if not options.interpreted:
            laps += speed(contest, sizes, options.laps)
            keep()
    if not (options.no_training or options.interpreted):
        dry = options.dry_run
        with sequence_at(options.data, DRY_FRAMES if dry else FRAMES, *((64, 48) if dry else (WIDTH, HEIGHT))) as data:
            names = list(dict.fromkeys([*(contest.backend for contest in everyone), "cpu"]))
            for run in runs_of(names, data, DRY_ITERATIONS if dry else None):
                runs.append(run)
                keep()
    print(page(facts, first_ms, gaps, laps, runs))
    return 0 if gaps and all(g.agrees for g in gaps) else 1


if __name__ == "__main__":
    sys.exit(main())
