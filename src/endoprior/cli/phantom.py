"""`endoprior phantom OUT`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..phantom import PhantomConfig
from ..system.console import say
from .parsing import parse


@dataclass
class Phantom:
    """Write a synthetic surgical sequence with full ground truth."""

    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """Sequence folder to write; must be new or empty."""
    config: Annotated[PhantomConfig, tyro.conf.arg(name="")] = field(default_factory=PhantomConfig)


def run(argv: list[str]) -> None:
    """Write the sequence."""
    args = parse(Phantom, argv, "phantom")
    from ..phantom import write_phantom

    write_phantom(args.out, args.config)
    say(f"{args.out}: {args.config.frames} frames of {args.config.width}x{args.config.height}")
