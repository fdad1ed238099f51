"""`endoprior bench masks OUT`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from endoprior.cli.arguments import Command, parse
from endoprior.core.checks import input_error
from endoprior.system.console import say


@dataclass
class BenchMasks(Command):
    """Train the network that finds tools without each set of real frames, and score it on that set.

    A network takes hours. Networks in OUT are kept, and an interrupted training resumes. The clips are read from
    the folder that the environment variable ENDOPRIOR_DATA names.
    """

    out: Path = field(metadata={"place": "OUT"})
    """Folder for networks, phantoms and the report."""
    steps: int = 8000
    """Training steps of each network, of 16 images each."""
    seed: int = 0
    """Seed of weights and examples."""
    pretrained: Path | None = None
    """Weights of EfficientNet-Lite0 that each network starts from (docs/tool_network.md); random without them."""
    write_weights: Path | None = None
    """Also write the weights of the network that was trained with all sets to this file."""

    examples = ("OUT", "OUT --steps 500")


def run(argv: list[str]) -> int:
    """Train, score, write the report."""
    args = parse(BenchMasks, argv, "bench masks")
    if not 1 <= args.steps <= 10**6:
        raise input_error("--steps", "1 to 1000000", f"{args.steps}", "Choose a value in this range.")
    root = Path(os.environ.get("ENDOPRIOR_DATA", ""))
    if not (root / "vocalfolds").is_dir():
        fix = "ENDOPRIOR_DATA=FOLDER with bowel_lift/, vocalfolds/, mono_endo.mp4 and wild/ (docs/tool_network.md)."
        raise input_error("ENDOPRIOR_DATA", "the folder of the clips", repr(str(root)), f"Set {fix}")
    from endoprior.cli.paths import require_writable_folder
    from endoprior.system.file_lock import locked

    from .fit import pretrained
    from .leave_one_out import ALL, Training, rows, weights_file, write_report

    require_writable_folder("OUT", args.out)
    start = pretrained(args.pretrained, args.seed) if args.pretrained else None
    args.out.mkdir(parents=True, exist_ok=True)
    with locked(args.out, args.out / ".lock"):
        table = []
        for row in rows(args.out, root, Training(args.steps, args.seed, start), say):
            say(f"{row.name}: {', '.join(f'{k} {v:.3f}' for k, v in row.score.total.scores().items())}")
            table.append(row)
        settings = {
            "steps": args.steps,
            "seed": args.seed,
            "pretrained": args.pretrained.name if args.pretrained else "no",
        }
        report = write_report(args.out, table, settings)
        if args.write_weights:
            args.write_weights.write_bytes(weights_file(args.out, ALL).read_bytes())
    say(f"report: {report}")
    return 0
