"""`endoprior check DATA` and `endoprior prior DATA OUT`: look at a sequence before training."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..core.checks import InputError, input_error
from ..core.config import DataConfig
from ..core.shell import quoted
from ..system.console import say
from .arguments import Command


@dataclass
class Check(Command):
    """Check a sequence before training: print its properties and problems, and draw a figure."""

    folder: Path = field(metadata={"place": "DATA"})
    """Sequence folder."""
    out: Path | None = None
    """PNG file of the figure. Default: DATA_check.png beside DATA."""
    json: Path | None = None
    """Also write facts and findings to this file."""
    strict: bool = False
    """Exit with status 2 if there is a problem of severity `error`."""
    data: DataConfig = field(default_factory=DataConfig)

    examples = ("DATA", "DATA --out DATA.png --strict")
    basics = "--out --json --strict --data.first-frames --data.stride --data.shrink --data.format"

    def execute(self) -> None:
        """Measure the sequence, print the report, write the figure."""
        figure = self.out or figure_beside(self.folder)
        if figure.suffix.lower() != ".png":
            raise input_error("--out", "a .png file", str(figure), f"`--out {quoted(figure.with_suffix('.png'))}`.")
        from .paths import require_writable_file

        for option, file in (("--out", figure), ("--json", self.json)):
            if file is not None:
                require_writable_file(option, file, self.folder)
        from ..check import draw_check, find, measure
        from ..check.report import as_json, table
        from ..data import load_sequence
        from ..system.atomic import write_json

        sequence = load_sequence(self.folder, self.data)
        facts = measure(sequence, self.data)
        findings = find(facts)
        say(f"{self.folder}")
        for name, value in table(facts):
            say(f"  {name:<18}{value}")
        for finding in findings or ["no problems found"]:
            say(str(finding))
        if self.json:
            write_json(self.json, as_json(facts, findings))
        draw_check(sequence, facts, findings, figure)
        say(f"figure: {figure}")
        errors = [finding for finding in findings if finding.severity == "error"]
        if self.strict and errors:
            raise InputError(f"{self.folder}: expected no errors with --strict, got {len(errors)}: {errors[0]}")


def figure_beside(folder: Path) -> Path:
    """A file beside the sequence folder, named after it; in the current folder if nothing can be written there."""
    whole = folder if folder.name not in ("", "..") else Path(os.path.abspath(folder))
    file = whole.with_name(f"{whole.name or 'sequence'}_check.png")
    return file if os.access(file.parent, os.W_OK) else Path(file.name)


@dataclass
class Prior(Command):
    """Write the cue maps and the joint texture prior of each frame: one PNG per map, and a contact sheet."""

    data: Path = field(metadata={"place": "DATA"})
    """Sequence folder."""
    out: Path = field(metadata={"place": "OUT"})
    """Folder for specular/, salience/, prior/ and contact_sheet.png."""
    split: Literal["train", "test", "video"] = "video"
    """Frames to write."""

    examples = ("DATA OUT", "DATA OUT --split test")
    basics = "--split"

    def execute(self) -> None:
        """Write the maps."""
        from ..data import load_sequence
        from ..visualization.prior_maps import write_prior_maps

        sequence = load_sequence(self.data)
        sheet = write_prior_maps(sequence, self.split, self.out)
        say(f"{len(sequence.indices(self.split))} frames: {self.out}\ncontact sheet: {sheet}")
