"""`endoprior export RUN OUT`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from ..export.options import ExportOptions
from ..system.console import say
from .help_page import Help
from .parsing import parse
from .progress import Counting
from .trained_scene import open_scene


@dataclass(frozen=True, kw_only=True)
class Export(ExportOptions):
    """Write a trained scene in a format that other programs read (docs/export.md)."""

    run: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Run folder, or a scene.safetensors."""
    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """A file, or a new folder with one file for each time step. Its suffix says the format."""


HELP = Help(
    examples=(
        ("RUN", "tissue.ply", "--times", "0.5"),
        ("RUN", "tissue.obj", "--times", "0.5"),
        ("RUN", "OUT", "--format", "mesh", "--split", "test"),
        ("RUN", "player.html"),
    ),
    basics={
        "what to write": ("--format", "--mesh-format", "--frame"),
        "which times": ("--times", "--split", "--canonical"),
        "details": ("--mesh-method", "--min-alpha", "--points"),
    },
)


def run(argv: list[str]) -> None:
    """Export."""
    args = parse(Export, argv, "export", HELP)
    from ..export import export

    options = ExportOptions(**{field.name: getattr(args, field.name) for field in fields(ExportOptions)})
    scene = open_scene(args.run)
    with Counting() as progress:
        written = export(scene, args.out, options, partial(progress, "exporting"))
    for path in written:
        say(f"{path}")
    if scene.lengths_are_relative:
        say("note: the scale of this scene is assumed. Its lengths are not millimeters.")
