"""`endoprior train DATA OUT`."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Self

from ..core.checks import input_error
from ..core.config import Config
from ..core.config_io import SHORT_NAMES
from ..core.shell import command
from ..data import load_sequence
from ..data.load import not_trainable
from ..model.method import method_of
from ..model.presets import preset, preset_line, preset_names
from ..runs.folder import config_of_run, read_config, sequence_of_run
from ..runs.progress import training_progress
from ..system.console import say
from .arguments import Command, Parser, parse
from .devices import Wanted, with_device
from .evaluate import Eval, reject_missing_weights
from .paths import require_input_first
from .view import live_view


@dataclass
class Train(Command):
    """Train one scene and score it. The preset sets every number of the method; options change single ones."""

    data: Path = field(metadata={"place": "DATA"})
    """Sequence folder: of `endoprior prepare` or a dataset. To resume a run, `--resume RUN` alone is enough."""
    out: Path | None = field(default=None, metadata={"place": "OUT"})
    """Run folder to write."""
    preset: str = field(default="default", metadata={"choices": preset_names(), "metavar": "NAME"})
    """Method: a preset of the config."""
    config_file: Path | None = field(default=None, metadata={"name": "config", "metavar": "FILE"})
    """Config of another run (config.json), or YAML with some fields. It overrides the preset; options override it."""
    iterations: int = 0
    """Length of the training. What begins and ends in between keeps its share of it; in
    presets that follow a publication it keeps its number. With `--resume RUN`: its new length; rates stay where they
    ended, and no Gaussians are added after its former end."""
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
    tensorboard: bool = False
    """Also write what TensorBoard shows, made from the log: `tensorboard --logdir RUN`. Needs that package."""
    config: Config = field(default_factory=Config, metadata={"name": ""})

    examples = ("DATA RUN", "DATA RUN --iterations 3000 --gaussians 50000", "--resume RUN --iterations 3000")
    basics = (
        "--preset --config --seed --data.first-frames --data.shrink --iterations --resume"
        " --gaussians --device --view --tensorboard --no-networks --weights-dir"
    )
    short: ClassVar = {
        f"--{short}".replace("_", "-"): f"--{full}".replace("_", "-") for short, full in SHORT_NAMES.items()
    }

    @classmethod
    def more_help(cls) -> list[str]:
        """What each preset is."""
        return ["presets:", *(f"  {name:<19}{preset_line(name)}" for name in preset_names())]

    @classmethod
    def from_words(cls, argv: Sequence[str]) -> Self:
        """The parsed arguments. The config starts from a preset, then a file; a resumed run has that of its folder."""
        first = Parser(prog="endoprior train", add_help=False, allow_abbrev=False)  # so that --help shows their values
        first.add_argument("--preset", choices=preset_names())
        first.add_argument("--config", type=Path)
        first.add_argument("--iterations", type=int)
        first.add_argument("--eyes", "--data.eyes")
        typed, _ = first.parse_known_args(argv)
        name, file = typed.preset or "default", typed.config
        cfg = preset(name) if file is None else read_config(file, preset(name))
        if typed.iterations is not None:
            cfg = cfg.replace({"iterations": typed.iterations})
        elif typed.eyes == "both" != cfg.data.eyes and not cfg.schedule.literal:
            cfg = cfg.replace({"iterations": "x2"})  # as many of each eye as of one alone
        args = parse(cls, argv, "train", preset=name, config=cfg, iterations=cfg.schedule.total)
        if typed.iterations is not None and cfg.schedule.literal and not args.resume:
            say(
                "note: this preset follows a publication, so only the length changes; density control begins at "
                f"iteration {cfg.density.start_iteration:,}, the temporal term at {cfg.temporal.start_iteration:,}, "
                f"rates fall until {cfg.optim.decay_iterations:,}"
            )
        if not args.resume:
            if args.out is not None:
                require_input_first("train", args.data, args.out)
            if args.config.data.format == "auto" and (error := not_trainable(args.data)):
                raise error  # before kernels are compiled
            if args.out is None:
                fix = f"`{command('train', args.data, 'RUN')}`."
                raise input_error("endoprior train", "the run folder to write after DATA", "nothing", fix)
            return args
        data, run = args.data, args.out or args.data
        if typed.preset is None and file is None and (args.out is None or (run / "config.json").is_file()):
            cfg = config_of_run(run)
            cfg = cfg if typed.iterations is None else cfg.extended(typed.iterations)
            args = parse(cls, argv, "train", preset=name, config=cfg)
        else:  # every option repeats one of the run
            args = replace(args, iterations=0)
        if args.out is None:
            data = sequence_of_run(run, "`endoprior train DATA RUN --resume` with the folder of the sequence.")
        return replace(args, data=data, out=run)

    def execute(self) -> None:
        """Train, score, and print the results."""
        from ..render import ON_GPU

        wanted = self.device
        if self.resume and wanted == "auto":  # the device that the run was started on
            wanted = "cuda" if self.config.render.backend in ON_GPU else "cpu"
        cfg = with_device(self.config, wanted)
        reject_missing_weights(self.weights_dir)
        if not self.checkpoint_seconds >= 0:
            raise input_error("--checkpoint-seconds", "at least 0", str(self.checkpoint_seconds), "Remove it for 60.")
        if self.ray and self.view:
            raise input_error("--view", "a training in this process", f"--ray {self.ray}", "remove one of them.")
        if self.view and not method_of(cfg).has_gaussians:
            raise input_error("--view", "a method with Gaussians", cfg.method, "remove --view.")
        self.train_and_score(cfg)

    def train_and_score(self, cfg: Config) -> None:
        """Train with this config, write the run folder, score the test split, print the scores."""
        from ..runs.log import EventFiles, missed_tools_line, read_log
        from ..runs.remote import complete_on
        from ..runs.train import start_run
        from ..system.ray_cluster import connected
        from ..training.trainer import device_for

        out = self.out or self.data
        extends = self.resume and self.iterations == cfg.schedule.total  # 0 if it was not typed
        events = EventFiles(out) if self.tensorboard else None
        sequence = load_sequence(self.data, cfg.data)
        training = start_run(sequence, cfg, out, resume=self.resume, extends=extends, say=say)
        began = clock.perf_counter()
        try:
            if self.ray:
                with connected(self.ray, say) as cluster:
                    scene = complete_on(cluster, training, say, self.checkpoint_seconds)
            else:
                port = self.view_port if self.view else None
                with training_progress() as show_progress, live_view(port) as show_scene:
                    observers = [show_progress, show_scene, *([events] if events else [])]
                    scene = training.complete(*observers, checkpoint_seconds=self.checkpoint_seconds)
        except KeyboardInterrupt:
            say(f"Stopped; the state is saved in {out}. To resume, run the same command with --resume.")
            raise
        seconds, extra = clock.perf_counter() - began, {}
        if not self.resume:
            each = [line["seconds"] for line in read_log(out / "log.jsonl", "seconds")]
            rate = len(each) / max(sum(each), 1e-9) if each else 0.0  # of the logged iterations
            extra = {"train_seconds": seconds, "iterations_per_second": rate}
        del training  # frees its cached frames; scoring loads its own
        scene = scene.to(device_for(cfg.render.backend))  # score on the training device
        try:
            scoring = Eval(out, self.data, networks=self.networks, weights_dir=self.weights_dir)
            scores = scoring.score_run(scene, out, extra).scores
            if events:
                events.finish(scores, cfg.schedule.total)
            if line := missed_tools_line(out, self.data):
                say(line)
            if method_of(cfg).has_gaussians:
                say(f"To turn and measure it: `{command('view', out)}`")
            else:
                say(f"To get images and a video: `{command('render', out)}`")
        except KeyboardInterrupt:
            say(f"Stopped; the trained scene is saved in {out}. To score it: `{command('eval', out)}`.")
            raise


def require_gaussians(cfg: Config, fix: str) -> None:
    """Reject a method without Gaussians, with this `fix`: the report and the player need them."""
    if not method_of(cfg).has_gaussians:
        raise input_error("--preset", "a method with Gaussians, which all steps need", cfg.method, fix)
