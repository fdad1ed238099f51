"""Golden runs: train every preset on a small phantom and hash what comes out, to compare two checkouts bit for bit.

    PYTHONPATH=CHECKOUT/src python bench/golden.py before.json
    PYTHONPATH=OTHER/src python bench/golden.py after.json --against before.json

Hashes the arrays of `scene.safetensors`, of the checkpoint and the scores of `metrics.json` that do not depend on the
clock. Everything goes through the command line, so that the script runs on checkouts of any layout. Hashes compare on
one machine only.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from safetensors.numpy import load_file

PRESETS = (
    "default", "best", "paper", "released", "endogaussian", "deform3dgs", "endogs", "endo4dgs", "surgicalgaussian",
)  # fmt: skip
PHANTOM = ("--frames", "18", "--width", "160", "--height", "128", "--seed", "3")
SHORT = (
    "--schedule.coarse-iterations", "40", "--schedule.fine-iterations", "260", "--init.budget", "2500",
    "--density.start-iteration", "40", "--density.every", "50", "--density.prior-threshold", "0.4",
    "--temporal.start-iteration", "60", "--temporal.min-points", "8", "--temporal.min-valid", "1",
)  # fmt: skip
CLOCK = ("fps", "fps_cached", "train_seconds", "iterations_per_second")


def endoprior(*words: str | Path) -> None:
    done = subprocess.run([sys.executable, "-m", "endoprior", *map(str, words)], capture_output=True, encoding="utf-8")
    if done.returncode:
        sys.exit(f"endoprior {' '.join(map(str, words))}:\n{done.stdout[-2000:]}{done.stderr[-4000:]}")


def arrays_hash(file: Path) -> str:
    """SHA-256 of the names, types, shapes and bytes of all arrays in a safetensors file."""
    digest = hashlib.sha256()
    for name, array in sorted(load_file(file).items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=PRESETS)
    args = parser.parse_args()
    found = {}
    with tempfile.TemporaryDirectory() as temporary:
        # Kernels that Numba compiles and those that it loads from its cache may differ in the last bit: load them.
        endoprior("phantom", Path(temporary) / "cold", *PHANTOM)
        data = Path(temporary) / "phantom"
        endoprior("phantom", data, *PHANTOM)
        for preset in args.presets:
            run = Path(temporary) / preset
            endoprior("train", data, run, "--preset", preset, "--no-networks", *SHORT)
            scores = json.loads((run / "metrics.json").read_text(encoding="utf-8"))["scores"]
            found[preset] = {
                "scene": arrays_hash(run / "scene.safetensors"),
                "checkpoint": arrays_hash(run / "checkpoint.safetensors"),
                "scores": {name: value for name, value in scores.items() if name not in CLOCK},
            }
            print(preset, found[preset]["scene"][:16], found[preset]["scores"]["num_gaussians"], flush=True)
    args.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if args.against:
        before = json.loads(args.against.read_text(encoding="utf-8"))
        different = [f"{preset}: {part}" for preset in args.presets for part in found[preset]
                     if found[preset][part] != before[preset][part]]  # fmt: skip
        sys.exit(f"different: {', '.join(different)}" if different else 0)


if __name__ == "__main__":
    main()
