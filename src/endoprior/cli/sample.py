"""`endoprior sample OUT`: a stereo video with its calibration, to try what is meant for one's own video."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..core.shell import command
from ..phantom.sample import SampleConfig, calibration_text, sample_frames
from ..system.atomic import whole_folder, write_text
from ..system.console import say
from .arguments import Command
from .progress import Counting

VIDEO, CALIBRATION = "sample.mp4", "calibration.yaml"
README = """A made-up stereo endoscope video: {video}, left camera on the left, and its calibration.

Lens distortion, turned cameras, a round border, a label, a clock, sensor noise and H.264 are as in a real video.
It shows no patient: `endoprior sample OUT --seed {seed}` writes the same again.

A first look, then the whole model. Type this where you typed `endoprior sample`:

{commands}
"""


@dataclass
class Sample(Command):
    """Write a small made-up stereo video with its calibration, to try `run` and `prepare` without a video of yours.

    OUT gets sample.mp4 (60 frames, two cameras side by side), calibration.yaml and README.txt with the next commands.
    """

    out: Path = field(metadata={"place": "OUT"})
    """Folder to write; must be new or empty."""
    seed: int = 0
    """Seed of anatomy, motion and noise. The same seed gives the same video."""

    examples = ("OUT", "OUT --seed 1")

    def execute(self) -> None:
        """Write the clip."""
        cfg = SampleConfig(seed=self.seed)
        write_sample(self.out, cfg)
        say(f"{self.out}: {VIDEO} of {cfg.frames} frames, 2 x {cfg.width}x{cfg.height}, and {CALIBRATION}")
        say(f"next: `{_next(self.out, '--preview')}`")


def write_sample(out: Path, cfg: SampleConfig) -> None:
    """Write video, calibration and README.txt to `out`, a new or empty folder, which appears when complete.

    Raises:
        InputError: `out` is in use, or the seed is out of range.
    """
    from ..visualization.video import write_video

    with whole_folder(out) as folder, Counting() as progress:
        frames = sample_frames(cfg)

        def counted():
            for done, frame in enumerate(frames, 1):
                yield frame
                progress("frames", done, cfg.frames)

        write_video(folder / VIDEO, counted(), cfg.frames_per_second)
        write_text(folder / CALIBRATION, calibration_text(cfg))
        commands = "\n".join(f"    {_next(out, *options)}" for options in (("--preview",), ()))
        write_text(folder / "README.txt", README.format(video=VIDEO, seed=cfg.seed, commands=commands))


def _next(out: Path, *options: str) -> str:
    run = "PREVIEW" if options else "RUN"
    return command("run", out / VIDEO, run, "--calibration", out / CALIBRATION, *options)
