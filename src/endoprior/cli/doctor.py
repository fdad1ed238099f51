"""`endoprior doctor`."""

from __future__ import annotations

import json as json_text
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING

from ..system.console import say
from ..system.installation import docs_folder, source_commit
from .help_page import Help
from .parsing import parse

if TYPE_CHECKING:
    from ..doctor import Facts


@dataclass
class Doctor:
    """Report whether this computer can train, whether its GPU can be used, and what to install for it."""

    compile: bool = False
    """Compile gsplat now, which takes minutes, and render with it. Without a GPU, as in a container build, it compiles
    for the architectures in TORCH_CUDA_ARCH_LIST. Exit status 1 if that fails."""
    json: bool = False
    """Print JSON instead of a table."""


HELP = Help(examples=((), ("--json",)))


def run(argv: list[str]) -> int:
    """Print the report. Exit status 0 even if something is missing; 1 if --compile fails."""
    args = parse(Doctor, argv, "doctor", HELP)
    from ..doctor import examine, read_facts
    from ..doctor.choice import choose
    from ..doctor.report import as_json, table

    facts, compiling = read_facts(), ""
    if args.compile:
        facts, compiling = _compile(facts, quiet=args.json)
    report = examine(facts)
    choice = choose("auto", facts)
    status = 1 if args.compile and not facts.gsplat.loads else 0
    if args.json:
        found = as_json(facts, report, choice.device, choice.backend, choice.why, compiling)
        say(json_text.dumps(found, indent=1))
        return status
    say(f"endoprior {version('endoprior')}, commit {source_commit() or 'unknown'}; documentation: {docs_folder()}\n")
    for row in table(report):
        say(row)
    say("")
    if compiling:
        say(compiling)
    say(f"--device auto: {choice.why}")
    say(f"next: {report.next_step}")
    return status


def _compile(facts: Facts, quiet: bool) -> tuple[Facts, str]:
    """Compile gsplat if its requirements are met; return the new facts and a line about the result."""
    from ..doctor import examine
    from ..doctor.facts import compile_gsplat

    if problem := examine(facts).compile_problem:
        return facts, f"gsplat was not compiled: {problem}"
    if not quiet:
        say("compiling gsplat; this takes minutes")
    facts = compile_gsplat(facts)
    if not facts.gsplat.loads:
        return facts, f"gsplat did not compile: {facts.gsplat.error}"
    where = "" if facts.torch.available else "; no GPU to render with"
    return facts, f"gsplat is compiled, ready in {facts.gsplat.compile_seconds or 0:.0f} s{where}"
