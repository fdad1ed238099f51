"""`endoprior export RUN OUT`."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..export.formats import ExportOptions
from ..system.console import say
from .arguments import Help, parse
from .paths import folder_of, open_gaussians, sequence_of
from .progress import Counting

if TYPE_CHECKING:
    from ..export.formats import Format
    from ..model.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Export(ExportOptions):
    """Write a trained scene in a format that other programs read (docs/export.md)."""

    run: Path = field(metadata={"place": "RUN"})
    """Run folder, or a scene.safetensors."""
    out: Path = field(metadata={"place": "OUT"})
    """A new file, or a new folder with one file for each time step. Its suffix says the format."""
    overwrite: bool = False
    """Replace OUT if it is a file that exists."""


HELP = Help(
    examples=(
        ("RUN", "tissue.ply", "--times", "0.5"),
        ("RUN", "tissue.obj", "--times", "0.5"),
        ("RUN", "OUT", "--format", "mesh", "--split", "test"),
        ("RUN", "for_blender.glb", "--format", "animation"),
        ("RUN", "player.html"),
    ),
    basics={
        "what to write": ("--format", "--mesh-format", "--frame", "--overwrite"),
        "which times": ("--times", "--split", "--canonical"),
        "details": ("--mesh-method", "--min-alpha", "--points"),
    },
)


def run(argv: list[str]) -> None:
    """Export."""
    args = parse(Export, argv, "export", HELP)
    from ..export import export
    from .paths import require_new_file

    options = ExportOptions(**{field.name: getattr(args, field.name) for field in fields(ExportOptions)})
    scene = open_gaussians(args.run)
    if not args.overwrite:
        require_new_file(args.out)
    options = _with_data(scene, args.run, args.out, options)
    with Counting() as progress:
        written = export(scene, args.out, options, partial(progress, "exporting"))
    for path in written:
        say(f"{path}: {_words(scene, path, options)}")
    if scene.config.render.color_slopes and _holds(args.out, options) == "Gaussians":
        say("note: this format knows one color for each Gaussian, so its pictures are less sharp (docs/export.md).")
    if note := _chosen(args.out, options)[1].note:
        say(f"note: {note(scene, args.out, options)}")
    if scene.lengths_are_relative:
        say("note: the scale of this scene is assumed. Its lengths are not millimeters.")


def _with_data(scene: Scene, run: Path, out: Path, options: ExportOptions) -> ExportOptions:
    """`options` with the sequence folder of the run, for a format that uses it; with a note if there is none."""
    if "data" not in _chosen(out, options)[1].options:
        return options
    sequence = sequence_of(scene, folder_of(run), options.data, "there are no tool masks, and tools hide no point")
    return replace(options, data=sequence and sequence.path)


def _chosen(out: Path, options: ExportOptions) -> tuple[str, Format]:
    """The format's name, and the format."""
    from ..export.exporting import format_name
    from ..export.formats import load_format

    name = format_name(out, options)
    return name, load_format(name)


def _holds(out: Path, options: ExportOptions) -> str:
    """What the format holds, in plain words."""
    name, chosen = _chosen(out, options)
    return chosen.holds or name


def _words(scene: Scene, out: Path, options: ExportOptions) -> str:
    """What was written; without --format also what else a file of this suffix can hold, and how to get that."""
    from ..export.formats import formats_of, load_format

    (name, chosen), holds = _chosen(out, options), _holds(out, options)
    # Of several windows, a time shows one or two.
    count = f"{len(scene):,} " if holds == "Gaussians" and len(scene.windows) == 1 else ""
    words = f"{count}{holds}"
    if out.is_dir():
        words += ", one file for each time step" if chosen.files else ""
    elif options.format is None:
        others = [other for other in formats_of(out.suffix) if other != name]
        words += "".join(f"; for {load_format(other).holds or other}: --format {other}" for other in others)
    return words
