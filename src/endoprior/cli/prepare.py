"""`endoprior prepare VIDEO OUT`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..prepare.config import PrepareConfig
from .parsing import parse
from .progress import Counting, say


@dataclass
class Prepare:
    """Write a sequence folder from an endoscope video: eyes split and rectified, borders cut, depth, tool masks, poses.

    Give the same command again to go on after an interruption. Nothing is sent anywhere, and no metadata is
    copied; `--depth depth-anything` downloads its network.
    """

    video: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="VIDEO")]]
    """Video file, or folder of pictures."""
    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """Sequence folder to write; must be new or empty."""
    config: Annotated[PrepareConfig, tyro.conf.arg(name="")] = field(default_factory=PrepareConfig)


def run(argv: list[str]) -> None:
    """Prepare the sequence."""
    args = parse(Prepare, argv, "prepare")
    from ..prepare import prepare

    with Counting() as progress:
        done = prepare(args.video, args.out, args.config, progress)
    for remark in done.remarks:
        say(f"note: {remark}")
    say(f"{done.out}: {done.num_frames} frames of {done.size[0]}x{done.size[1]}")
    say(f"next: endoprior check {done.out}; endoprior train {done.out} RUN")
