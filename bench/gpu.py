"""The GPU backends compared with Numba and the reference, then timed: one command, no network.

    python bench/gpu.py [--run RUN] [--data FOLDER] [--wheel gsplat-*.whl] [--out FILE.json]

prints the machine, whether images and gradients agree, milliseconds, and a whole training, as Markdown for docs/gpu.md;
exit status 1 if a backend does not agree. It needs torch, NumPy, SciPy, Numba, OpenCV and PyYAML, and this checkout;
`--wheel` uses gsplat from a wheel that is not installed. `--dry-run` runs everything on the CPU with `numba` in place
of a GPU backend: it tests this file, not a GPU. `--interpreted` only checks, in some ten minutes, that Triton's kernels
agree when they are interpreted on the CPU.
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
from gpu_parity import SCENES, Difference, Target, agreement, compared, random_case, rendered  # noqa: F401
from gpu_speed import REPEATS, SIZES, Timing, speed, timed  # noqa: F401
from gpu_training import FRAMES, HEIGHT, WIDTH, Run, header, runs_of, sequence_at, table

from endoprior.core.checks import InputError
from endoprior.render import ON_GPU

DRY_FRAMES, DRY_ITERATIONS = 9, 6


def machine(target: Target) -> dict[str, str]:
    found = {"commit": str(common.source_commit()), "torch": torch.__version__, "date": time.strftime("%Y-%m-%d")}
    if target.device.type != "cuda":
        return found | {"GPU": "none, on the CPU"}
    major, minor = torch.cuda.get_device_capability(target.device)
    return found | {
        "GPU": f"{torch.cuda.get_device_name(target.device)} (compute capability {major}.{minor})",
        "driver": driver(),
        "CUDA of torch": str(torch.version.cuda),
        "gsplat": str(getattr(import_module("gsplat"), "__version__", "unknown")) if find_spec("gsplat") else "none",
        "Triton": str(getattr(import_module("triton"), "__version__", "unknown")) if find_spec("triton") else "none",
    }


def driver() -> str:
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(query, capture_output=True, encoding="utf-8", check=True, timeout=30).stdout
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return answer.splitlines()[0].strip() if answer.strip() else "unknown"


def page(
    facts: dict[str, str],
    first_ms: dict[str, float],
    differences: list[Difference],
    timings: list[Timing],
    runs: list[Run],
) -> str:
    """Markdown for docs/gpu.md."""
    lines = [*header("what", "found"), *(f"| {name} | {value} |" for name, value in facts.items())]
    lines += [
        f"| first image by {name}, its compilation included | {ms / 1e3:.1f} s |" for name, ms in first_ms.items()
    ]
    measures = ("color", "alpha", "depth, mm", "relative", "pixels beyond 1e-3", "gradient", "")
    lines += ["", *header("backend", "scene", "against", *measures)]
    for d in summed(differences):
        lines.append(
            f"| {d.backend} | {d.scene} | {d.against} | {d.color:.1e} | {d.alpha:.1e} | {d.depth_mm:.1e} "
            f"| {d.depth:.1e} | {d.stray:.4%} | {d.gradient:.1e} ({d.worst}) | {'agrees' if d.agrees else 'DIFFERS'} |"
        )
    lines += ["", *header("backend", "stage, 640x512", "Gaussians", "ms", "images/s", "peak memory, MB")]
    for t in timings:
        numbers = f"{t.note} |" if t.ms is None else f"{t.ms:.3f} | {1e3 * t.images / t.ms:,.0f}"
        memory = "" if t.memory_mb is None else f"{t.memory_mb:,.0f}"
        lines.append(f"| {t.backend} | {t.stage} | {t.gaussians:,} | {numbers} | {memory} |")
    return "\n".join(lines + (["", *table(runs)] if runs else []))


def summed(differences: list[Difference]) -> list[Difference]:
    """The random scenes of a backend in one row per comparison, the worst of each number; other rows unchanged."""
    rows = []
    for backend, against in dict.fromkeys((d.backend, d.against) for d in differences if d.kind == "random"):
        group = [d for d in differences if (d.kind, d.backend, d.against) == ("random", backend, against)]
        worst = max(group, key=lambda d: d.gradient)
        most = {n: max(getattr(d, n) for d in group) for n in ("color", "alpha", "depth_mm", "depth", "stray")}
        rows.append(replace(worst, scene=f"random, worst of {len(group)}", **most))
    return rows + [d for d in differences if d.kind != "random"]


def use_wheel(wheel: Path) -> None:
    folder = wheel.parent / wheel.stem
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    sys.path.insert(0, str(folder))


def targets(options: argparse.Namespace) -> list[Target]:
    if options.dry_run or options.interpreted:
        return [Target("triton" if options.interpreted else "numba", torch.device("cpu"))]
    device = torch.device("cuda", 0)
    names = options.backends or [name for name in ON_GPU if find_spec(name)]
    return [Target(name, device) for name in names]


def arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, metavar="RUN", help="a trained run folder, compared too")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="sequence to train on (default: a phantom)")
    parser.add_argument("--wheel", type=Path, metavar="FILE", help="gsplat's wheel, if it is not installed")
    parser.add_argument("--out", type=Path, metavar="FILE", help="also write everything as JSON there")
    parser.add_argument("--dry-run", action="store_true", help="on the CPU, with `numba` in place of a GPU backend")
    parser.add_argument("--interpreted", action="store_true", help="Triton's kernels on the CPU: agreement only")
    parser.add_argument("--backends", nargs="+", choices=ON_GPU, help="(default: all that are installed)")
    parser.add_argument("--scenes", type=int, default=SCENES, help="random scenes (default %(default)s)")
    parser.add_argument("--gaussians", type=int, nargs="+", help="sizes to time (default 20000 40000 100000)")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="of each timing (default %(default)s)")
    parser.add_argument("--no-training", action="store_true", help="leave out the training")
    return parser


def main(words: list[str] | None = None) -> int:
    options = arguments().parse_args(words)
    if options.wheel:
        use_wheel(options.wheel)
    if options.interpreted:
        os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is imported
    if not (options.dry_run or options.interpreted) and not torch.cuda.is_available():
        print("expected a GPU that torch can use; found none. Try `endoprior doctor`, or --dry-run.", file=sys.stderr)
        return 2
    sizes = SIZES if not options.gaussians else tuple(common.Size(num, 640, 512) for num in options.gaussians)
    everyone = targets(options)
    facts, first_ms, differences, timings, runs = machine(everyone[0]), {}, [], [], []

    def save() -> None:  # after each part: the machine may have a time limit
        if options.out:
            parts = {"facts": facts, "first_ms": first_ms, "runs": [asdict(run) for run in runs]}
            parts["differences"] = [asdict(d) | {"agrees": d.agrees} for d in differences]
            parts["timings"] = [asdict(timing) for timing in timings]
            options.out.write_text(json.dumps(parts, indent=2) + "\n", "utf-8")

    for target in everyone:
        began = time.perf_counter()
        try:
            rendered(target.backend, target.device, random_case(0))
        except InputError as error:  # the others are still measured
            timings.append(Timing(target.backend, "first image", 0, note=str(error)))
            continue
        first_ms[target.backend] = 1e3 * (time.perf_counter() - began)
        differences += agreement(target, options.scenes, options.run)
        save()
        if not options.interpreted:
            timings += speed(target, sizes, options.repeats)
            save()
    if not (options.no_training or options.interpreted):
        dry = options.dry_run
        with sequence_at(options.data, DRY_FRAMES if dry else FRAMES, *((64, 48) if dry else (WIDTH, HEIGHT))) as data:
            names = list(dict.fromkeys([*(target.backend for target in everyone), "numba"]))
            for run in runs_of(names, data, DRY_ITERATIONS if dry else None):
                runs.append(run)
                save()
    print(page(facts, first_ms, differences, timings, runs))
    return 0 if differences and all(d.agrees for d in differences) else 1


if __name__ == "__main__":
    sys.exit(main())
