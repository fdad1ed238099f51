"""`endoprior demo [OUT]`."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, field
from pathlib import Path

from ..model.presets import PresetName, preset
from ..system.console import say
from .arguments import Help, parse


@dataclass
class Demo:
    """Everything once, on synthetic data: phantom sequence -> train -> eval -> render, with a report."""

    out: Path = field(default=Path("demo"), metadata={"place": "OUT"})
    """Folder for sequence/, run/, report.png; must be new or empty."""
    preset: PresetName = "default"
    """Config to train with."""
    frames: int = 48
    """Frames of the phantom."""
    seed: int = 0
    """Seed of the phantom and of the training."""


HELP = Help(examples=((), ("OUT", "--frames", "16")))


def run(argv: list[str]) -> None:
    """Write the phantom, train, score, render, and print the results' paths."""
    args = parse(Demo, argv, "demo", HELP)
    from dataclasses import replace

    from ..data import load_sequence
    from ..model.scene_file import load_scene
    from ..phantom import PhantomConfig, write_phantom
    from ..runs.folder import prepare_run_folder
    from ..runs.report import write_report
    from .render import Render, render
    from .run import require_gaussians
    from .train import train_and_evaluate

    phantom, cfg = PhantomConfig(frames=args.frames, seed=args.seed), replace(preset(args.preset), seed=args.seed)
    require_gaussians(cfg, "Leave --preset out.")
    prepare_run_folder(args.out, resume=False)
    began = clock.perf_counter()
    data, folder = args.out / "sequence", args.out / "run"
    say(f"1/4  a phantom of {args.frames} frames: {data}")
    write_phantom(data, phantom)
    say("2/4  training")
    # Network scores may start large downloads, which a demo should not do.
    train_and_evaluate(data, cfg, folder, resume=False, networks=False, weights_dir=None)
    say("\n3/4  rendering")
    scene = load_scene(folder)
    render(scene, Render(run=folder))
    say("4/4  report")
    report = args.out / "report.png"
    write_report(scene, load_sequence(data), folder, report)
    say(f"\nDone in {clock.perf_counter() - began:.0f} s. Look at:\n  {report}\n  {folder / 'video.mp4'}")
