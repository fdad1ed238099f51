"""`endoprior COMMAND --help`: the options that most users need; `--help-all`: every option."""

from __future__ import annotations

import re
from argparse import ArgumentParser, HelpFormatter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from ..core.shell import command as shell_command
from .options import Option


@dataclass(frozen=True)
class Help:
    """What the help page of a command shows besides its options. Stands beside the dataclass of the command."""

    examples: tuple[tuple[str, ...], ...] = ()
    """Words of example commands, after the name of the command."""
    basics: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """What options are for -> their names, as they are typed. `--help` shows these; empty shows all options."""
    short: Mapping[str, str] = field(default_factory=dict)
    """Short name -> the option it stands for: `--iterations` -> `--schedule.fine-iterations`."""


PLAIN = Help()
"""All options, no examples."""


def help_page(name: str, about: str, arguments: Sequence[Option], page: Help, *, everything: bool) -> str:
    """The text of `--help`, or of `--help-all` if `everything`.

    Args:
        name: the command, such as `train`.
        about: its description.
        arguments: all of its options and positional arguments.
    """
    positional = [each for each in arguments if each.is_positional]
    named = [each for each in arguments if not each.is_positional]
    places = " ".join(each.name if each.is_required else f"[{each.name}]" for each in positional)
    layout = partial(HelpFormatter, max_help_position=28)
    usage = f"endoprior {name} {places}".rstrip() + (" [options]" if named else "")
    parser = ArgumentParser(usage=usage, description=about.replace("%", "%%"), add_help=False, formatter_class=layout)
    for each in positional:
        parser.add_argument(each.name, help=_explanation(each, each.text))
    if page.basics and not everything:
        known = {name: each for each in named for name in each.names}
        for title, names in page.basics.items():
            group = parser.add_argument_group(title)
            for typed in names:
                each = known[page.short.get(typed, typed)]
                _add(group, each, [typed], re.split(r"(?<=\.)\s", each.text)[0])
    else:
        for section in dict.fromkeys(each.section for each in named):
            members = [each for each in named if each.section == section]
            group = parser.add_argument_group(f"{section} options".strip(), members[0].about or None)
            for each in members:
                names = [each.off if each.is_flag and each.default is True else each.name]
                names += [short for short, option in page.short.items() if option == each.name]
                _add(group, each, names, each.text)
    lines = [parser.format_help()]
    if page.examples:
        lines += ["examples:", *(f"  {shell_command(name, *words)}" for words in page.examples), ""]
    if page.basics and not everything:
        lines += [f"--help-all lists all {len(named)} options."]
    return "\n".join(lines).rstrip()


def _add(group: ArgumentParser, option: Option, names: Sequence[str], text: str) -> None:
    if option.is_flag:
        text = f"Switch off: {text}" if option.default is True else text
        group.add_argument(*names, action="store_true", help=_explanation(option, text))
    else:
        group.add_argument(*names, metavar=option.metavar, help=_explanation(option, text))


def _explanation(option: Option, text: str) -> str:
    """The text for argparse, with the default where there is one to show."""
    default = option.default
    if isinstance(default, tuple):
        default = " ".join(map(str, default))
    shown = not option.is_flag and not option.is_required and default not in (None, "")
    return (f"{text} (default: {default})" if shown else text).replace("%", "%%").strip()
