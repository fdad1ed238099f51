"""`endoprior train DATA OUT`."""

from __future__ import annotations

import dataclasses
import json
import time as clock
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import tyro

from ..core.checks import InputError
from ..core.config import Config
from ..core.presets import PresetName, preset
from ..doctor.choice import Wanted
from .parsing import parse
from .progress import say, training_progress
from .view import live_view

if TYPE_CHECKING:
    from ..training.state import StepReport
    from ..training.trainer import Trainer


@dataclass
class Train:
    """Train one scene and score it. Every option below --view-port is a field of the config; the preset sets it."""

    data: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="DATA")]]
    """Sequence folder: images/, masks/, depth/, poses_bounds.npy."""
    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """Run folder to write."""
    preset: PresetName = "default"
    """Where the config starts from."""
    init_budget: int | None = None
    """Short for --init.budget."""
    device: Wanted = "auto"
    """Where to compute; auto takes CUDA only where all of it works (`endoprior doctor`)."""
    weights_dir: Path | None = None
    """Folder with the weights of RAFT and LPIPS."""
    networks: bool = True
    """Also score with RAFT and LPIPS where their weights can be had."""
    resume: bool = False
    """Continue the run in OUT, after Ctrl-C or a crash, to the same bits."""
    checkpoint_seconds: float = 60.0
    """Time between two checkpoints: the longest that a crash can cost."""
    view: bool = False
    """Show the scene in a web browser while it trains, at 127.0.0.1 and --view-port. Takes time from the training."""
    view_port: int = 8080
    """Port of --view; 0 takes any free one."""
    config: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)


def run(argv: list[str]) -> None:
    """Train, score, and print where the results are."""
    from ..doctor.choice import choose_here
    from ..render import ON_GPU

    args = parse(Train, argv, "train", default=_preset_defaults(argv))
    cfg = args.config
    named = cfg.render.backend if cfg.render.backend in ON_GPU else None
    if named and args.device == "cpu":
        raise InputError(f"--render.backend {named}: expected --device cuda or auto; got cpu. Leave one of them out.")
    choice = choose_here("cuda" if named else args.device)
    say(choice.why)
    if choice.device == "cuda" and not named:
        cfg = dataclasses.replace(cfg, render=dataclasses.replace(cfg.render, backend=choice.backend))
    if args.weights_dir and not args.weights_dir.is_dir():
        raise InputError(f"{args.weights_dir}: expected a folder with weights; found none. Correct --weights-dir.")
    if args.init_budget is not None:
        try:
            cfg = dataclasses.replace(cfg, init=dataclasses.replace(cfg.init, budget=args.init_budget))
        except ValueError as error:
            raise InputError(f"--init-budget: {error}. Correct it.") from None
    port = args.view_port if args.view else None
    if not args.checkpoint_seconds >= 0:
        raise InputError(
            f"--checkpoint-seconds: expected at least 0; got {args.checkpoint_seconds}. Leave it out for 60."
        )
    kept = {"resume": args.resume, "checkpoint_seconds": args.checkpoint_seconds}
    train_and_evaluate(args.data, cfg, args.out, args.networks, args.weights_dir, port, **kept)


def train_and_evaluate(
    data: Path,
    cfg: Config,
    out: Path,
    networks: bool,
    weights_dir: Path | None,
    view_port: int | None = None,
    *,
    resume: bool = False,
    checkpoint_seconds: float = 60.0,
) -> None:
    """Train on the folder `data` into the run folder `out`, score the test split there, print the scores.

    Args:
        view_port: serve a live view of the training there; None does not.
        resume, checkpoint_seconds: as `train.train` has them.
    """
    from ..data import load_sequence
    from ..runs.training_run import TrainingRun
    from ..training.trainer import device_for
    from .evaluate import evaluate_run

    training = TrainingRun(load_sequence(data, cfg.data), cfg, out, resume=resume, say=say)
    began = clock.perf_counter()
    try:
        with training_progress() as show_progress, live_view(view_port) as show_scene:

            def on_step(report: StepReport, trainer: Trainer) -> None:
                show_progress(report, trainer)
                show_scene(report, trainer)

            scene = training.complete(on_step, checkpoint_seconds=checkpoint_seconds)
    except KeyboardInterrupt:
        say(f"Stopped; the state is saved. Go on with the same command and --resume ({out}).")
        raise
    seconds = clock.perf_counter() - began
    del training  # and with it the frames it caches: scoring reads its own
    done = _logged_seconds(out / "log.jsonl")
    speed = {"train_seconds": seconds, "iterations_per_second": done}
    scene = scene.to(device_for(cfg.render.backend))  # drawn where it was trained
    try:
        evaluate_run(scene, data, out, "test", networks, weights_dir, extra=speed if not resume else {})
    except KeyboardInterrupt:
        say(f"Stopped; the trained scene is saved. Score it with `endoprior eval {out}`.")
        raise


def _logged_seconds(log: Path) -> float:
    """Iterations per second by the log: the reciprocal of the mean time of the iterations it shows."""
    seconds = [json.loads(line)["seconds"] for line in log.read_text().splitlines()]
    return len(seconds) / max(sum(seconds), 1e-9) if seconds else 0.0


def _preset_defaults(argv: list[str]) -> Train:
    """Defaults with the config of the preset named in `argv`, so that --help and options build on it."""
    name = "default"
    for i, word in enumerate(argv):
        if word == "--preset" and i + 1 < len(argv):
            name = argv[i + 1]
        elif word.startswith("--preset="):
            name = word.removeprefix("--preset=")
    if name not in get_args(PresetName):
        raise InputError(
            f"--preset: expected one of {', '.join(get_args(PresetName))}; got {name!r}. Choose one of them."
        )
    return Train(data=tyro.MISSING, out=tyro.MISSING, preset=name, config=preset(name))
