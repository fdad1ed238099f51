"""`endoprior phantom OUT` and `endoprior demo [OUT]`: synthetic data, and everything once on it."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..core.shell import command
from ..data import load_sequence
from ..model.presets import preset, preset_names
from ..phantom import PhantomConfig
from ..system.console import say
from .arguments import Command


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
