"""`endoprior completion SHELL`: a script that completes commands, options, their choices and files."""

from __future__ import annotations

from argparse import SUPPRESS, ArgumentParser
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import shtab

from ..core.config import Config
from ..system.console import say
from .arguments import Command, options, parser_of

Shell = Literal["bash", "zsh", "fish"]
SHELLS: tuple[str, ...] = get_args(Shell)
PLACES = {
    "bash": "~/.local/share/bash-completion/completions/endoprior",
    "zsh": "_endoprior in a folder of $fpath, such as ~/.zfunc/_endoprior",
    "fish": "~/.config/fish/completions/endoprior.fish",
}


@dataclass
class Completion(Command):
    """Print a script for your shell: the Tab key then completes commands, options, their choices and files.

    Write it once where the shell looks for it, and again after an update; then start a new shell.
    """

    shell: Shell = field(metadata={"place": "SHELL"})
    """bash, zsh or fish."""

    examples = SHELLS

    @classmethod
    def more_help(cls) -> list[str]:
        """Where each shell looks."""
        return ["where to write it:", *(f"  {shell:<6}{place}" for shell, place in PLACES.items())]

    def execute(self) -> None:
        """Print the script."""
        say(shtab.complete(whole_parser(), self.shell))


def whole_parser() -> ArgumentParser:
    """One parser of all commands with all their options; `endoprior` itself makes only that of the typed command."""
    from . import descriptions

    whole = ArgumentParser("endoprior", add_help=False)
    for flag in ("--help", "--version"):
        whole.add_argument(flag, action="store_true")
    commands = whole.add_subparsers()
    for name, command in _commands():
        about = {"help": descriptions()[name], "add_help": False, "prefix_chars": "-"}
        if command is None:  # of another package, which does not tell its options
            commands.add_parser(name, **about)
            continue
        defaults = {"config": Config()} if name == "train" else {}
        parser = parser_of(command, name, list(options(command, defaults)), everything=True)
        parser.add_argument("-h", "--help", action="store_true", help="the main options")
        parser.add_argument("--help-all", action="store_true", help="every option")
        for action in parser._actions:  # the only way to them that argparse has, and shtab takes it, too
            takes_file = action.type in (Path, str) and not action.choices and action.help != SUPPRESS
            if takes_file:
                action.complete = shtab.FILE  # pyright: ignore[reportAttributeAccessIssue]
        commands.add_parser(name, parents=[parser], **about)
    return whole


def _commands() -> Iterator[tuple[str, type[Command] | None]]:
    """Name and class of every command; None for a plugin whose module has no `arguments`."""
    from . import COMMANDS, REGISTRY

    for name in COMMANDS:
        yield name, REGISTRY.load(name)
    for name, module in REGISTRY.usable():
        yield name, module.arguments() if hasattr(module, "arguments") else None
