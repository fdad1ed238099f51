"""`endoprior eval RUN`, `endoprior eval --pictures FOLDER DATA`, and `endoprior eval --masks TRUTH DATA`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..core.checks import input_error
from ..core.shell import command
from ..system.console import say
from ..system.installation import page
from .arguments import Help, parse
from .devices import Wanted, on_device
from .paths import folder_of, open_scene
from .score_table import score_table

if TYPE_CHECKING:
    from ..data import FrameSequence
    from ..evaluation.context import Evaluation
    from ..model.scene import RenderedScene


BETTER = "\u2191 higher is better, \u2193 lower is better"
MOST_MM_PER_UNIT = 1e6
"""Largest --depth-scale."""


@dataclass
class Eval:
    """Score a trained scene, another program's images, or tool masks; writes metrics.json and per_frame.json.

    Splits other than test have files of their own: metrics_train.json, per_frame_train.json.
    """

    run: Path = field(metadata={"place": "RUN"})
    """Run folder; with --pictures or --masks the sequence folder."""
    data: Path | None = None
    """Sequence folder. Default: the one the run was trained on."""
    split: Literal["test", "train", "video"] = "test"
    """Frames to score."""
    out: Path | None = None
    """Folder for the two files. Default: RUN, or the folder of --pictures; with --masks none are written."""
    pictures: Path | None = None
    """Score the frames in this folder, PNG of 8 or 16 bits, in place of a run (docs/benchmarks.md)."""
    depth_pictures: Path | None = None
    """Depth of these frames: NPY in mm, or 16-bit PNG with --depth-scale."""
    depth_scale: float | None = None
    """mm per unit of the depth files."""
    masks: Path | None = None
    """Score the tool masks of DATA against the true masks in this folder (docs/scores.md)."""
    name: str = ""
    """Name of the method in metrics.json. Default: that of the folder."""
    protocol: str = ""
    """Also score as other papers did: names such as `endonerf,endogs`, or `all` (docs/scores.md)."""
    networks: bool = True
    """Scores by networks (RAFT, LPIPS). They need their weights."""
    weights_dir: Path | None = None
    """Folder with the weights of RAFT and LPIPS."""
    device: Wanted = "auto"
    """Where to compute. `auto` uses CUDA only if all of it works (`endoprior doctor`)."""


HELP = Help(
    examples=(("RUN",), ("RUN", "--split", "train"), ("--pictures", "FOLDER", "DATA"), ("--masks", "TRUTH", "DATA"))
)


def run(argv: list[str]) -> None:
    """Score and print."""
    args = parse(Eval, argv, "eval", HELP)
    from ..evaluation.protocols.table import chosen_protocols
    from ..runs.folder import sequence_of_run
    from .paths import require_writable_folder

    if args.masks:
        evaluate_masks(args, args.masks)
        return
    if args.weights_dir and not args.weights_dir.is_dir():
        raise input_error(args.weights_dir, "a folder with weights", "none", "Correct --weights-dir.")
    protocols = chosen_protocols(args.protocol) if args.protocol else ()
    if args.pictures:
        evaluate_pictures(args, args.pictures, protocols)
        return
    if given := [o for o in ("depth_pictures", "depth_scale", "name") if getattr(args, o) not in (None, "")]:
        option = f"--{given[0].replace('_', '-')}"
        raise input_error(option, "--pictures beside it", "a run", f"Remove {option}, or add --pictures FOLDER.")
    scene = open_scene(args.run)
    run = folder_of(args.run)
    out = args.out or run
    require_writable_folder("--out" if args.out else "RUN", out)
    data = args.data or sequence_of_run(run)
    scene = on_device(scene, args.device)
    evaluate_run(scene, run, data, out, args.split, args.networks, args.weights_dir, extra={}, protocols=protocols)


def evaluate_run(
    scene: RenderedScene,
    run: Path,
    data: Path,
    out: Path,
    split: Literal["test", "train", "video"],
    networks: bool,
    weights_dir: Path | None,
    extra: dict[str, float],
    protocols: Sequence[str] = (),
) -> None:
    """Score the `scene` of a `run` on the sequence folder `data`, write the two files into `out`, print a table.

    Depth is scored against measured depth, even where the run's preset trained on filled-in depth.
    """
    from ..data import load_sequence
    from ..evaluation.scoring import evaluate, scored_data
    from ..runs.log import growth_of, mask_facts

    sequence = load_sequence(data, scored_data(scene.config.data))
    result = evaluate(scene, sequence, split, networks=networks, weights_dir=weights_dir, protocols=protocols)
    growth = growth_of(run)
    result.scores |= extra | ({"gaussians_growth": growth.ratio} if growth else {})
    result.protocol |= mask_facts(run)
    save_and_print(result, sequence, out, split, run)


def evaluate_pictures(args: Eval, folder: Path, protocols: Sequence[str]) -> None:
    """Score the rendered frames in `folder` on the sequence that takes the place of the run."""
    from ..data import load_sequence
    from ..evaluation.pictures import Pictures
    from ..evaluation.scoring import evaluate
    from .paths import require_writable_folder

    if args.data:
        raise input_error("--data", "--pictures FOLDER DATA", "--data as well", "Remove --data.")
    if args.depth_scale is not None and not 0 < args.depth_scale <= MOST_MM_PER_UNIT:
        want = f"a number above 0, up to {MOST_MM_PER_UNIT:g}"
        raise input_error("--depth-scale", want, f"{args.depth_scale}", "Correct it.")
    out = args.out or folder
    require_writable_folder("--out" if args.out else "--pictures", out)
    sequence = load_sequence(args.run)
    depth = {"depth_folder": args.depth_pictures, "depth_scale": args.depth_scale}
    pictures = Pictures(folder, sequence, args.split, name=args.name, **depth)
    for line in pictures.remarks:
        say(line)
    networks = {"networks": args.networks, "weights_dir": args.weights_dir}
    result = evaluate(pictures, sequence, args.split, **networks, protocols=protocols)
    save_and_print(result, sequence, out, args.split)


def evaluate_masks(args: Eval, folder: Path) -> None:
    """Score the masks of the sequence that takes the place of the run against the true masks in `folder`."""
    from ..data import load_sequence
    from ..evaluation.true_masks import TrueMasks, score_masks
    from .paths import require_writable_folder

    plain = Eval(args.run, out=args.out, masks=folder)
    if other := next((f.name for f in fields(Eval) if getattr(args, f.name) != getattr(plain, f.name)), None):
        option = f"--{'no-' if other == 'networks' else ''}{other.replace('_', '-')}"
        raise input_error(
            option, "--masks TRUTH DATA, with no option but --out", f"{option} as well", f"Remove {option}."
        )
    if args.out:
        require_writable_folder("--out", args.out)
    sequence = load_sequence(args.run)
    truth = TrueMasks(folder, sequence)
    total = len(sequence)
    say(f"{truth.folder}: true masks of {len(truth.indices)} of {total} frames, {truth.matched_by}")
    say(f"true masks: {truth.polarity}")
    result = score_masks(sequence, truth)
    say(f"\nscores of the tool masks in {len(truth.indices)} frames ({BETTER})")
    for line in score_table(result.scores, result.skipped):
        say(line)
    if left_out := result.protocol["share_of_pixels_left_out"]:
        say(f"note: {left_out:.1%} of the pixels do not count: border around the image, or burned-in labels")
    saved = f"all scores: {result.save(args.out)}" if args.out else "to keep the scores: --out FOLDER"
    say(f"{saved}; what they mean: {page('scores.md')}")


def save_and_print(
    result: Evaluation,
    sequence: FrameSequence,
    out: Path,
    split: Literal["test", "train", "video"],
    run: Path | None = None,
) -> None:
    """Write the two files into `out`, and print a table; name frames to look at in the `run`, if there is one."""
    from .score_table import protocol_table

    file = result.save(out)
    held_out = f"; {sequence.split_rule}" if sequence.test_phase else ""
    say(f"\nscores of the {len(sequence.indices(split))} {split} frames ({BETTER}{held_out})")
    for line in score_table(result.scores, result.skipped, sequence.depth_is_relative):
        say(line)
    for line in protocol_table(result, sequence.depth_is_relative):
        say(line)
    if outliers := result.outlier_frames():
        frames = ", ".join(map(str, outliers))
        look = f". To see them: `{command('render', run, '--split', split)}`" if run else ""
        say(f"note: tissue PSNR of frames {frames} is more than 3 dB below the median{look}")
    say(f"all scores: {file}; what they mean: {page('scores.md')}")
