"""`endoprior export RUN OUT`."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.checks import input_error
from ..data.reading import kind_of
from ..export.formats import ExportOptions
from ..system.console import say
from .arguments import Command
from .paths import folder_of, open_gaussians, sequence_if_there
from .progress import Counting

if TYPE_CHECKING:
    from ..export.formats import ExportFormat
    from ..model.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Export(ExportOptions, Command):
    """Write a trained scene in a format that other programs read (docs/export.md)."""

    run: Path = field(metadata={"place": "RUN"})
    """Run folder, or a scene.safetensors."""
    out: Path = field(metadata={"place": "OUT"})
    """A new file, or a new folder with one file for each time step. Its suffix says the format."""
    overwrite: bool = False
    """Replace OUT if it is a file that exists."""

    examples = (
        "RUN tissue.ply --times 0.5",
        "RUN tissue.obj --times 0.5",
        "RUN OUT --format mesh --split test",
        "RUN for_blender.glb --format animation",
        "RUN player.html",
    )
    basics = "--format --mesh-format --frame --overwrite --times --split --canonical --mesh-method --min-alpha --points"

    def execute(self) -> None:
        """Export."""
        from ..export import export
        from ..export.exporting import format_name, loss_note
        from ..export.formats import load_format

        given = {each.name: getattr(self, each.name) for each in fields(ExportOptions)}
        scene = open_gaussians(self.run)
        if not self.overwrite and kind_of(self.out) == "a file":
            raise input_error(self.out, "a new file", "one that exists", "Choose another name, or add --overwrite.")
        name = format_name(self.out, ExportOptions(**given))
        chosen = load_format(name)
        if "data" in chosen.options:
            without = "there are no tool masks, and tools hide no point"
            sequence = sequence_if_there(scene, folder_of(self.run), self.data, without)
            given["data"] = sequence and sequence.path
        options = ExportOptions(**given)
        with Counting() as progress:
            written = export(scene, self.out, options, partial(progress, "exporting"))
        for path in written:
            say(f"{path}: {self._words(scene, name, chosen)}")
        if lost := loss_note(scene, self.out, options, chosen):
            say(f"note: {lost}")
        if chosen.note:
            say(f"note: {chosen.note(scene, self.out, options)}")
        if scene.lengths_are_relative:
            say("note: the scale of this scene is assumed. Its lengths are not millimeters.")

    def _words(self, scene: Scene, name: str, chosen: ExportFormat) -> str:
        """What was written; without --format also what else a file of this suffix can hold, and how to get that."""
        from ..export.formats import formats_of, load_format

        # Of several windows, a time shows one or two.
        counts = chosen.holds == "Gaussians" and len(scene.windows) == 1
        words = f"{len(scene):,} Gaussians" if counts else chosen.holds or name
        if self.out.is_dir():
            return words + (", one file for each time step" if chosen.files else "")
        others = [other for other in formats_of(self.out.suffix) if other != name] if self.format is None else []
        return words + "".join(f"; for {load_format(other).holds or other}: --format {other}" for other in others)
