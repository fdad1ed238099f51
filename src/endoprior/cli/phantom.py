"""`endoprior phantom OUT`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..core.shell import command
from ..phantom import PhantomConfig
from ..system.console import say
from .arguments import Help, parse


@dataclass
class Phantom:
    """Write a synthetic surgical sequence with full ground truth."""

    out: Path = field(metadata={"place": "OUT"})
    """Sequence folder to write; must be new or empty."""
    config: PhantomConfig = field(default_factory=PhantomConfig, metadata={"name": ""})


HELP = Help(
    examples=(("DATA",), ("DATA", "--frames", "16", "--width", "320", "--height", "256", "--stereo")),
    basics={
        "size": ("--frames", "--width", "--height", "--stereo"),
        "scene": (
            "--seed",
            "--instruments",
            "--tissue",
            "--camera",
            "--breathing-mm",
            "--pull-mm",
            "--slide-mm",
            "--smooth-share",
            "--noise",
        ),
    },
)


def run(argv: list[str]) -> None:
    """Write the sequence."""
    args = parse(Phantom, argv, "phantom", HELP)
    from ..phantom import write_phantom

    write_phantom(args.out, args.config)
    say(f"{args.out}: {args.config.frames} frames of {args.config.width}x{args.config.height}")
    say(f"next: {command('train', args.out, 'RUN')}")
