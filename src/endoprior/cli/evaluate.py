"""`endoprior eval RUN`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..core.checks import input_error
from ..doctor.choice import Wanted
from .devices import on_device
from .parsing import parse
from .progress import say
from .trained_scene import open_scene

if TYPE_CHECKING:
    from ..model.scene import Scene


@dataclass
class Eval:
    """Score a trained scene; writes metrics.json and per_frame.json into the run folder (or --out).

    Splits other than test have files of their own: metrics_train.json, per_frame_train.json.
    """

    run: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Run folder."""
    data: Path | None = None
    """Sequence folder; default: the one the run was trained on."""
    split: Literal["test", "train", "video"] = "test"
    """Frames to score."""
    out: Path | None = None
    """Folder for the two files."""
    networks: bool = True
    """Also compute the scores that need a network (RAFT, LPIPS), where their weights are found."""
    weights_dir: Path | None = None
    """Folder with the weights of RAFT and LPIPS."""
    device: Wanted = "auto"
    """Where to render; `auto` uses CUDA only if everything it needs works (see `endoprior doctor`)."""


def run(argv: list[str]) -> None:
    """Score and print."""
    args = parse(Eval, argv, "eval")
    from ..runs.stored_run import sequence_of_run
    from .output_paths import require_writable_folder

    if args.weights_dir and not args.weights_dir.is_dir():
        raise input_error(args.weights_dir, "a folder of network weights", "none", "correct --weights-dir.")
    scene = open_scene(args.run)
    require_writable_folder(
        "--out" if args.out else "RUN", args.out or (args.run if args.run.is_dir() else args.run.parent)
    )
    data = args.data or sequence_of_run(args.run)
    scene = on_device(scene, args.device)
    evaluate_run(scene, data, args.out or args.run, args.split, args.networks, args.weights_dir, extra={})


def evaluate_run(
    scene: Scene,
    data: Path,
    out: Path,
    split: Literal["test", "train", "video"],
    networks: bool,
    weights_dir: Path | None,
    extra: dict[str, float],
) -> None:
    """Score `scene` on the sequence folder `data`, write the two files into `out`, print a table.

    Depth is scored against measured depth, even where the run's preset trained on filled-in depth.
    """
    from ..data import load_sequence
    from ..evaluation.registry import all_scores
    from ..evaluation.scoring import evaluate, scored_data

    sequence = load_sequence(data, scored_data(scene.config.data))
    result = evaluate(scene, sequence, split, networks=networks, weights_dir=weights_dir)
    result.scores |= extra
    file = result.save(out)
    say(f"\nscores on the {split} split ({len(sequence.indices(split))} frames)")
    for name, value in result.scores.items():
        say(f"  {name:<28}{all_scores()[name].text(value)}")
    for name, reason in result.skipped.items():
        say(f"  {name:<28}skipped: {reason}")
    if outliers := result.outlier_frames():
        frames = ", ".join(map(str, outliers))
        say(
            f"note: tissue PSNR of frames {frames} is more than 3 dB below the median; see them with `endoprior render`"
        )
    if sequence.depth_is_relative:
        say("note: the sequence's depth is relative: scores in mm compare runs on it, but are not millimeters")
    say(f"{file}")
