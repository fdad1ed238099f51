"""`endoprior prepare VIDEO OUT`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..core.shell import command
from ..prepare.config import PrepareConfig
from ..system.console import say
from .arguments import Help, parse
from .progress import Counting


@dataclass
class Prepare:
    """Write a sequence folder from an endoscope video: rectified frames, depth, tool masks and camera poses.

    To resume after an interruption, run the same command again. Your video never leaves this computer. Of its metadata
    only its path is kept, in OUT/prepare.json. `depth-anything` and `sam2` are downloaded.
    """

    video: Path = field(metadata={"place": "VIDEO"})
    """Video file, or folder of images."""
    out: Path = field(metadata={"place": "OUT"})
    """Sequence folder to write; must be new or empty."""
    config: PrepareConfig = field(default_factory=PrepareConfig, metadata={"name": ""})


HELP = Help(
    examples=(
        ("video.mp4", "DATA"),
        ("stereo.mp4", "DATA", "--calibration", "calib.yaml"),
        ("video.mp4", "DATA", "--start", "10", "--end", "20", "--frames-per-second", "10"),
    ),
    basics={
        "cameras": ("--calibration", "--right"),
        "frames": ("--start", "--end", "--frames-per-second", "--max-width"),
        "depth, tools and camera path": ("--depth", "--masks", "--poses"),
    },
)


def run(argv: list[str]) -> None:
    """Prepare the sequence."""
    args = parse(Prepare, argv, "prepare", HELP)
    from ..data.description import RECORD
    from ..prepare import prepare

    with Counting() as progress:
        done = prepare(args.video, args.out, args.config, progress)
    for note in done.notes:
        say(f"note: {note}")
    say(f"note: {done.out / RECORD} holds the path of your video; delete it before you share the folder")
    say(f"{done.out}: {done.num_frames} frames of {done.size[0]}x{done.size[1]}")
    say(f"next: {command('check', done.out)}")
    say(f"then: {command('train', done.out, 'RUN')}")
