"""The command `endoprior bench`, which imports nothing before it runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from endoprior.cli.arguments import Command

ABOUT = "compare methods on sequences over seeds, under one protocol"


def arguments() -> type[Command]:
    """The class of its arguments, for `endoprior completion`."""
    from .bench import Bench

    return Bench


def run(argv: list[str]) -> int:
    """See `bench.run`."""
    from .bench import run as bench

    return bench(argv)
