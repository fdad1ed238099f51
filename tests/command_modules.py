"""Where the arguments of a command are parsed."""

from endoprior.cli import COMMANDS, MODULES


def module_of(name: str) -> str:
    """The module of a command, or of `bench masks`."""
    if name not in COMMANDS:
        return {"bench": "endoprior_studies.bench", "bench masks": "endoprior_studies.tool_training.bench"}[name]
    return f"endoprior.cli.{MODULES.get(name, name)}"
