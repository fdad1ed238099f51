"""Synthetic data, `endoprior phantom OUT` and `endoprior sample OUT`; everything once on it, `endoprior demo [OUT]`."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, field, replace
from pathlib import Path
from shutil import copyfile

from ..core.shell import command
from ..data import load_sequence
from ..model.presets import preset, preset_names
from ..phantom import PhantomConfig
from ..phantom.sample import RECORDED, SampleConfig, calibration_text, sample_frames
from ..system.atomic import whole_folder, write_text
from ..system.console import say
from .arguments import Command
from .progress import Counting

VIDEO, CALIBRATION = "sample.mp4", "calibration.yaml"
CONSTANT_RATE_FACTOR = 20  # small enough to come with the program
README = """A made-up stereo endoscope video: {video}, left camera on the left, and its calibration.

Lens distortion, turned cameras, a round border, a label, a clock, sensor noise and H.264 are as in a real video.
It shows no patient: `endoprior sample OUT --seed {seed}` writes the same again.

A first look, then the whole model. Type this where you typed `endoprior sample`:

{commands}
"""


@dataclass
class Phantom(Command):
    """Write a synthetic surgical sequence with full ground truth."""

    out: Path = field(metadata={"place": "OUT"})
    """Sequence folder to write; must be new or empty."""
    config: PhantomConfig = field(default_factory=PhantomConfig, metadata={"name": ""})

    examples = ("DATA", "DATA --frames 16 --width 320 --height 256 --stereo")
    basics = (
        "--scene --frames --width --height --stereo --seed --instruments --tissue --smoke --camera --mechanics --events"
    )

    def execute(self) -> None:
        """Write the sequence."""
        from ..phantom import write_phantom

        write_phantom(self.out, self.config)
        say(f"{self.out}: {self.config.frames} frames of {self.config.width}x{self.config.height}")
        say(f"next: `{command('train', self.out, 'RUN')}`")


@dataclass
class Sample(Command):
    """Write a small made-up stereo video with its calibration, to try `run` and `prepare` without a video of yours.

    OUT gets sample.mp4 (60 frames, two cameras side by side), calibration.yaml and README.txt with the next commands.
    """

    out: Path = field(metadata={"place": "OUT"})
    """Folder to write; must be new or empty."""
    seed: int = 0
    """Seed of anatomy, motion and noise. The same gives the same video; 0 comes with the program."""

    examples = ("OUT", "OUT --seed 1")

    def execute(self) -> None:
        """Write the clip."""
        cfg = SampleConfig(seed=self.seed)
        write_sample(self.out, cfg, RECORDED if cfg == SampleConfig() else None)
        say(f"{self.out}: {VIDEO} of {cfg.frames} frames, 2 x {cfg.width}x{cfg.height}, and {CALIBRATION}")
        say(f"next: `{_next(self.out, '--preview')}`")


def write_sample(out: Path, cfg: SampleConfig, recorded: Path | None = None) -> None:
    """Write video, calibration and README.txt to `out`, a new or empty folder, which appears when complete.

    Args:
        recorded: the video, drawn before; None draws it.
    Raises:
        InputError: `out` is in use, or the seed is out of range.
    """
    from ..visualization.video import write_video

    with whole_folder(out) as folder, Counting() as progress:

        def counted():
            for done, frame in enumerate(sample_frames(cfg), 1):
                yield frame
                progress("frames", done, cfg.frames)

        if recorded:
            copyfile(recorded, folder / VIDEO)
        else:
            write_video(folder / VIDEO, counted(), cfg.frames_per_second, CONSTANT_RATE_FACTOR)
        write_text(folder / CALIBRATION, calibration_text(cfg))
        commands = "\n".join(f"    {_next(out, *options)}" for options in (("--preview",), ()))
        write_text(folder / "README.txt", README.format(video=VIDEO, seed=cfg.seed, commands=commands))


def _next(out: Path, *options: str) -> str:
    run = "PREVIEW" if options else "RUN"
    return command("run", out / VIDEO, run, "--calibration", out / CALIBRATION, *options)


@dataclass
class Demo(Command):
    """Everything once, on synthetic data: phantom sequence -> train -> eval -> render, with a report."""

    out: Path = field(default=Path("demo"), metadata={"place": "OUT"})
    """Folder for sequence/, run/, report.png; must be new or empty."""
    preset: str = field(default="default", metadata={"choices": preset_names()})
    """Config to train with."""
    frames: int = 48
    """Frames of the phantom."""
    seed: int = 0
    """Seed of the phantom and of the training."""

    examples = ("", "OUT --frames 16")

    def execute(self) -> None:
        """Write the phantom, train, score, render, and print the results' paths."""
        from ..phantom import write_phantom
        from ..runs.folder import prepare_run_folder
        from ..runs.report import write_report
        from .paths import open_gaussians
        from .render import Render
        from .train import Train, require_gaussians

        phantom, cfg = PhantomConfig(frames=self.frames, seed=self.seed), replace(preset(self.preset), seed=self.seed)
        require_gaussians(cfg, "Leave --preset out.")
        prepare_run_folder(self.out, resume=False)
        began = clock.perf_counter()
        data, run, report = self.out / "sequence", self.out / "run", self.out / "report.png"
        say(f"1/4  a phantom of {self.frames} frames: {data}")
        write_phantom(data, phantom)
        say("2/4  training")
        # Network scores may start large downloads, which a demo should not do.
        Train(data, run, networks=False).train_and_score(cfg)
        say("\n3/4  rendering")
        scene = open_gaussians(run)
        Render(run).render(scene)
        say("4/4  report")
        write_report(scene, load_sequence(data), run, report)
        say(f"\nDone in {clock.perf_counter() - began:.0f} s. Look at:\n  {report}\n  {run / 'video.mp4'}")
