"""`endoprior train DATA OUT`."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import get_args

from ..core.checks import input_error
from ..core.config import Config
from ..core.config_io import SHORT_NAMES
from ..core.shell import command
from ..model.presets import PresetName, preset
from ..runs.folder import config_of_run, read_config, sequence_of_run
from ..runs.progress import training_progress
from ..system.console import say
from .arguments import Help, parse
from .devices import Wanted, with_device
from .view import live_view


@dataclass
class Train:
    """Train one scene and score it. The preset sets every number of the method; options change single ones."""

    data: Path = field(metadata={"place": "DATA"})
    """Sequence folder: of `endoprior prepare` or a dataset. To resume a run, `--resume RUN` alone is enough."""
    out: Path | None = field(default=None, metadata={"place": "OUT"})
    """Run folder to write."""
    preset: PresetName = "default"
    """Method: a preset of the config."""
    config_file: Path | None = field(default=None, metadata={"name": "config", "metavar": "FILE"})
    """Config of another run (config.json), or YAML with some fields. It overrides the preset; options override it."""
    device: Wanted = "auto"
    """Where to compute. `auto` uses CUDA only if all of it works (`endoprior doctor`)."""
    weights_dir: Path | None = None
    """Folder with the weights of RAFT and LPIPS."""
    networks: bool = True
    """Scores by networks (RAFT, LPIPS). They need their weights."""
    resume: bool = False
    """Continue a run after a stop, with its data and config. The result is bit-identical to an uninterrupted run."""
    checkpoint_seconds: float = 60.0
    """Time between two checkpoints, and the most time that a crash can cost."""
    ray: str | None = None
    """Train on a Ray cluster that shares this file system: its address, `auto`, or `local`, which starts one. The
    windows of a long sequence train at the same time; a machine that is lost costs the work since a checkpoint."""
    view: bool = False
    """Show the scene in a web browser during training. At 127.0.0.1 and --view-port; it slows down training."""
    view_port: int = 8080
    """Port of --view; 0 uses any free port."""
    config: Config = field(default_factory=Config, metadata={"name": ""})


HELP = Help(
    examples=(
        ("DATA", "RUN"),
        ("DATA", "RUN", "--iterations", "3000", "--gaussians", "50000"),
        ("--resume", "RUN"),
    ),
    basics={
        "method": ("--preset", "--config", "--seed"),
        "what to train on": ("--data.first-frames", "--data.shrink"),
        "how long": ("--iterations", "--resume"),
        "how large": ("--gaussians",),
        "where it runs": ("--device",),
        "during and after training": ("--view", "--no-networks", "--weights-dir"),
    },
    short={f"--{short}".replace("_", "-"): f"--{full}".replace("_", "-") for short, full in SHORT_NAMES.items()},
)


def run(argv: list[str]) -> None:
    """Train, score, and print the results."""
    from ..render import ON_GPU

    args = arguments(argv)
    wanted = args.device
    if args.resume and wanted == "auto":  # the device that the run was started on
        wanted = "cuda" if args.config.render.backend in ON_GPU else "cpu"
    cfg = with_device(args.config, wanted)
    if args.weights_dir and not args.weights_dir.is_dir():
        raise input_error(args.weights_dir, "a folder with weights", "none", "Correct --weights-dir.")
    port = args.view_port if args.view else None
    if not args.checkpoint_seconds >= 0:
        raise input_error("--checkpoint-seconds", "at least 0", str(args.checkpoint_seconds), "Remove it for 60.")
    if args.ray and args.view:
        raise input_error("--view", "a training in this process", f"--ray {args.ray}", "remove one of them.")
    from ..model.method import method_of

    if args.view and not method_of(cfg).has_gaussians:
        raise input_error("--view", "a method with Gaussians", cfg.method, "remove --view.")
    kept = {"resume": args.resume, "checkpoint_seconds": args.checkpoint_seconds, "ray": args.ray}
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
    ray: str | None = None,
) -> None:
    """Train on the folder `data`, write the run folder `out`, score the test split, print the scores.

    Args:
        view_port: port of a live view of the training; None for no view.
        resume, checkpoint_seconds: as in `runs.train.train`.
        ray: address of a Ray cluster that trains; None trains in this process.
    """
    from ..data import load_sequence
    from ..runs.log import missed_tools_line
    from ..runs.remote import complete_on
    from ..runs.train import start_run
    from ..system.ray_cluster import connected
    from ..training.trainer import device_for
    from .evaluate import evaluate_run

    training = start_run(load_sequence(data, cfg.data), cfg, out, resume=resume, say=say)
    began = clock.perf_counter()
    try:
        if ray:
            with connected(ray, say) as cluster:
                scene = complete_on(cluster, training, say, checkpoint_seconds)
        else:
            with training_progress() as show_progress, live_view(view_port) as show_scene:
                scene = training.complete(show_progress, show_scene, checkpoint_seconds=checkpoint_seconds)
    except KeyboardInterrupt:
        resume_with = resume_command(out, networks, weights_dir, checkpoint_seconds, ray)
        say(f"Stopped; the state is saved in {out}. To resume, run `{resume_with}`.")
        raise
    seconds = clock.perf_counter() - began
    del training  # frees its cached frames; scoring loads its own
    done = _logged_seconds(out / "log.jsonl")
    speed = {} if resume else {"train_seconds": seconds, "iterations_per_second": done}
    scene = scene.to(device_for(cfg.render.backend))  # score on the training device
    try:
        evaluate_run(scene, out, data, out, "test", networks, weights_dir, extra=speed)
        if line := missed_tools_line(out, data):
            say(line)
    except KeyboardInterrupt:
        say(f"Stopped; the trained scene is saved. Score it with `{command('eval', out)}`.")
        raise


def _logged_seconds(log: Path) -> float:
    """Iterations per second: the reciprocal of the mean time of the logged iterations."""
    from ..runs.log import read_log

    seconds = [line["seconds"] for line in read_log(log, "seconds")]
    return len(seconds) / max(sum(seconds), 1e-9) if seconds else 0.0


def arguments(argv: list[str]) -> Train:
    """The parsed arguments. The config starts from a preset, then a file; a resumed run has that of its folder.

    Raises:
        InputError: as `parse`; no such preset; OUT is missing; or a config or the run to resume cannot be read.
    """
    named, file = typed(argv, "--preset"), typed(argv, "--config")  # now, so that --help shows their values
    name = named or "default"
    if name not in get_args(PresetName):
        raise input_error("--preset", f"one of {', '.join(get_args(PresetName))}", repr(name), "`--preset default`.")
    cfg = preset(name) if file is None else read_config(Path(file), preset(name))
    args = parse(Train, argv, "train", HELP, preset=name, config=cfg)
    if not args.resume:
        if args.out is None:
            fix = f"`{command('train', args.data, 'RUN')}`."
            raise input_error("endoprior train", "the run folder to write after DATA", "nothing", fix)
        return args
    data, run = args.data, args.out or args.data
    if named is None and file is None and (args.out is None or (run / "config.json").is_file()):
        args = parse(Train, argv, "train", HELP, preset=name, config=config_of_run(run))
    if args.out is None:
        moved = f"`{command('train', 'DATA', run, '--resume')}` with the folder of the sequence."
        data = sequence_of_run(run, moved)
    return replace(args, data=data, out=run)


def typed(argv: Sequence[str], option: str) -> str | None:
    """The value of an option in the arguments, the last one if there are several; None without it."""
    value = None
    for word, following in zip_longest(argv, argv[1:]):
        if word == option and following is not None:
            value = following
        elif word.startswith(f"{option}="):
            value = word.partition("=")[2]
    return value


def resume_command(
    run: Path, networks: bool, weights_dir: Path | None, checkpoint_seconds: float, ray: str | None = None
) -> str:
    """The command that resumes an interrupted training; config and data are those of the run folder."""
    words: list[str | Path] = [] if networks else ["--no-networks"]
    words += ["--weights-dir", weights_dir] if weights_dir else []
    words += ["--checkpoint-seconds", f"{checkpoint_seconds:g}"] if checkpoint_seconds != 60 else []
    words += ["--ray", ray] if ray else []
    return command("train", "--resume", run, *words)
