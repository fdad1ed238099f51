"""`endoprior sample OUT`: a stereo video with its calibration, to try what is meant for one's own video."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from shutil import copyfile

from ..core.shell import command
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
