"""`endoprior prior DATA OUT`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..system.console import say
from .arguments import Help, parse


@dataclass
class Prior:
    """Write the cue maps and the joint texture prior of each frame: one PNG per map, and a contact sheet."""

    data: Path = field(metadata={"place": "DATA"})
    """Sequence folder."""
    out: Path = field(metadata={"place": "OUT"})
    """Folder for specular/, salience/, prior/ and contact_sheet.png."""
    split: Literal["train", "test", "video"] = "video"
    """Frames to write."""


HELP = Help(
    examples=(("DATA", "OUT"), ("DATA", "OUT", "--split", "test")),
    basics={"which frames": ("--split",)},
)


def run(argv: list[str]) -> None:
    """Write the maps."""
    args = parse(Prior, argv, "prior", HELP)
    from ..data import load_sequence
    from ..visualization.prior_maps import write_prior_maps

    sequence = load_sequence(args.data)
    sheet = write_prior_maps(sequence, args.split, args.out)
    say(f"{len(sequence.indices(args.split))} frames: {args.out}\ncontact sheet: {sheet}")
