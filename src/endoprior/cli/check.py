"""`endoprior check DATA`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..core.checks import InputError, input_error
from ..core.config import DataConfig
from ..core.shell import quoted
from ..system.console import say
from .arguments import Help, parse


@dataclass
class Check:
    """Check a sequence before training: print its properties and problems, and draw a figure."""

    folder: Path = field(metadata={"place": "DATA"})
    """Sequence folder."""
    out: Path = Path("check.png")
    """PNG file of the figure."""
    json: Path | None = None
    """Also write facts and findings to this file."""
    strict: bool = False
    """Exit with status 2 if there is a problem of severity `error`."""
    data: DataConfig = field(default_factory=DataConfig)


HELP = Help(
    examples=(("DATA",), ("DATA", "--out", "DATA.png", "--strict")),
    basics={
        "results": ("--out", "--json", "--strict"),
        "which frames": ("--data.first-frames", "--data.stride", "--data.shrink", "--data.format"),
    },
)


def run(argv: list[str]) -> None:
    """Measure the sequence, print the report, write the figure."""
    args = parse(Check, argv, "check", HELP)
    if args.out.suffix.lower() != ".png":
        fix = f"`--out {quoted(args.out.with_suffix('.png'))}`."
        raise input_error("--out", "a .png file", str(args.out), fix)
    from .paths import require_writable_file

    for option, file in (("--out", args.out), ("--json", args.json)):
        if file is not None:
            require_writable_file(option, file, args.folder)
    from ..check import draw_check, find, measure
    from ..check.report import as_json, table
    from ..data import load_sequence
    from ..system.atomic import write_json

    sequence = load_sequence(args.folder, args.data)
    facts = measure(sequence, args.data)
    findings = find(facts)
    say(f"{args.folder}")
    for name, value in table(facts):
        say(f"  {name:<18}{value}")
    for finding in findings:
        say(str(finding))
    if not findings:
        say("no problems found")
    if args.json:
        write_json(args.json, as_json(facts, findings))
    draw_check(sequence, facts, findings, args.out)
    say(f"figure: {args.out}")
    errors = [finding for finding in findings if finding.severity == "error"]
    if args.strict and errors:
        raise InputError(f"{args.folder}: expected no errors with --strict, got {len(errors)}: {errors[0]}")
