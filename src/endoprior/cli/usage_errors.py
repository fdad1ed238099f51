"""Errors about arguments that cannot be parsed, one line each."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence

from ..core.checks import InputError, input_error, last_part, similar_name
from .options import Option, option_name

MEANT = {
    "fps": "--frames-per-second",
    "rate": "--frames-per-second",
    "epochs": "--iterations",
    "iters": "--iterations",
    "steps": "--iterations",
    "cuda": "--device",
    "gpu": "--device",
    "force": "--overwrite",
    "output": "--out",
    "resolution": "--max-width",
}
"""Words of other programs -> the option of the same meaning."""
BOX_DRAWING = re.compile(r"[\u2500-\u257f]+")


def reject_unknown(argv: Sequence[str], command: str, names: Sequence[str]) -> None:
    """Raise InputError for the first option in `argv` that is not in `names`; it suggests the most similar one."""
    for word in argv:
        name = option_name(word)
        if name.startswith("--") and name not in names:
            same = MEANT.get(last_part(name))
            similar = same if same in names else similar_name(name, names)
            meant = f"Did you mean {similar}? " if similar else ""
            fix = f"{meant}`endoprior {command} --help-all` lists all options."
            raise input_error(f"endoprior {command}", "an option that it has", name, fix)


def unknown_command(name: str, commands: Mapping[str, str]) -> InputError:
    """The error for a word that is no command; suggests the most similar one.

    Args:
        commands: what the user may type -> the command it stands for.
    """
    similar = difflib.get_close_matches(name.lower(), commands, 1)
    meant = f"Did you mean `endoprior {commands[similar[0]]}`? " if similar else ""
    listed = ", ".join(dict.fromkeys(commands.values()))
    return input_error(name, f"one of {listed}", "no such command", f"{meant}`endoprior --help` explains each.")


def usage_error(
    page: str, argv: Sequence[str], command: str, arguments: Sequence[Option], short: Mapping[str, str]
) -> InputError:
    """The error for what tyro says of a missing argument, one too many, or a value that does not suit its option.

    Args:
        page: what tyro printed.
        arguments: all options and positional arguments of the command.
        short: short names of options.
    """
    text, fix = _one_line(page), f"`endoprior {command} --help`."
    places = [each.name for each in arguments if each.is_positional]
    if "Missing from" in text:
        missing = [name for name in places if re.search(rf"\b{re.escape(name)}\b", text)]
        return input_error(f"endoprior {command}", " ".join(places), f"no {' and no '.join(missing)}", fix)
    if "Unrecognized options: " in text:
        expected = " ".join(places) or "options only"
        return input_error(f"endoprior {command}", expected, text.partition("Unrecognized options: ")[2], fix)
    text = text.rpartition("Error parsing ")[2]
    by_name = {name: option for option in arguments for name in option.names}
    for word, value in zip(argv, [*argv[1:], ""], strict=True):
        option = by_name.get(short.get(option_name(word), option_name(word)))
        if option and (beyond := re.match(rf"\S+: ({last_part(option.name).replace('-', '_')} must .*)", text)):
            return InputError(f"{option_name(word)}: {beyond[1]}. Fix: {fix}")
        if option and re.search(rf"{re.escape(option.name)}(?![\w-]|\.\w)", text):
            got = word.partition("=")[2] or value
            return input_error(option_name(word), _in_words(option.metavar), repr(got) if got else "nothing", fix)
    return InputError(f"{text}. Fix: {fix}")


def _in_words(metavar: str) -> str:
    """What a value must be."""
    if metavar.startswith("{"):
        return f"one of {', '.join(metavar.strip('{}').split(','))}"
    return {"": "no value", "INT": "an integer", "FLOAT": "a number", "FLOAT ...": "numbers", "PATH": "a path"}.get(
        metavar, metavar
    )


def _one_line(page: str) -> str:
    """The error in tyro's framed page, without the frame, its title, explanations and the closing advice."""
    body = [BOX_DRAWING.sub(" ", line).strip() for line in page.splitlines() if not line.startswith("\u256d")]
    text = " ".join(" ".join(body).split())
    return re.split("Argument helptext:|For full helptext", text)[0].rstrip(". ")
