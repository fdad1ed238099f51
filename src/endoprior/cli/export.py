"""`endoprior export RUN OUT --format ...`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from ..export.options import ExportOptions
from .parsing import parse
from .progress import Counting, say
from .trained_scene import open_scene


@dataclass(frozen=True, kw_only=True)
class Export(ExportOptions):
    """Write a trained scene in a format that other programs read; docs/export.md says which."""

    run: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Run folder, or a scene.safetensors."""
    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """File, if it ends in the format's suffix and there is one time step to write; else a new folder."""


def run(argv: list[str]) -> None:
    """Export."""
    args = parse(Export, argv, "export")
    from ..export import export

    options = ExportOptions(**{field.name: getattr(args, field.name) for field in fields(ExportOptions)})
    scene = open_scene(args.run)
    with Counting() as progress:
        written = export(scene, args.out, options, partial(progress, "exporting"))
    for path in written:
        say(f"{path}")
    if scene.lengths_are_relative:
        say("note: the scale of this scene is assumed: its lengths are not millimeters")
