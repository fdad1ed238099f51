"""`endoprior doctor`."""

from __future__ import annotations

import json as json_text
from dataclasses import dataclass

from .parsing import parse
from .progress import say


@dataclass
class Doctor:
    """Say whether this machine can use CUDA and what to install, before anything needs it."""

    compile: bool = False
    """Have gsplat compile itself now, which takes minutes, time it, and draw with it."""
    json: bool = False
    """Print JSON instead of a table."""


def run(argv: list[str]) -> None:
    """Look, judge, print. What is missing is no failure: the exit status is 0."""
    args = parse(Doctor, argv, "doctor")
    from ..device import choose
    from ..doctor import examine, look
    from ..doctor.facts import compile_gsplat
    from ..doctor.report import as_json, table

    facts = look()
    report = examine(facts)
    note = ""
    if args.compile:
        if report.works or (report.blocking is not None and report.blocking.name == "gsplat compiled"):
            if not args.json:
                say("gsplat compiles; this takes minutes")
            facts = compile_gsplat(facts)
            report = examine(facts)
        else:
            note = f"gsplat was not compiled: first mend {report.blocking.name}"
    choice = choose("auto", facts)
    if args.json:
        say(json_text.dumps(as_json(facts, report, choice.device, choice.why), indent=1))
        return
    for row in table(report):
        say(row)
    say("")
    if note:
        say(note)
    say(f"--device auto: {choice.why}")
    say(f"next: {report.next_step}")
