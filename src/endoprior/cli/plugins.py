"""`endoprior plugins`."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.checks import InputError
from ..system.console import say
from .arguments import Help, parse

LINE = "{:<11}{:<20}{:<28}{}"


@dataclass
class Plugins:
    """List datasets, methods, scores, ...: what is built in, and what other packages add (docs/plugins.md)."""


HELP = Help(examples=((),))


def run(argv: list[str]) -> None:
    """Import every plugin and print one line for each."""
    parse(Plugins, argv, "plugins", HELP)
    from ..data.formats import REGISTRY as DATASETS
    from ..evaluation.protocols.table import PROTOCOLS
    from ..evaluation.registry import REGISTRY as SCORES
    from ..export.formats import REGISTRY as EXPORTERS
    from ..model.method import METHODS
    from ..model.presets import PRESETS
    from ..system.plugins import OWN_PACKAGE, Registry, installed
    from . import REGISTRY as COMMANDS

    def found(registry: Registry) -> list[tuple[str, str, str]]:
        """Name, package and error of everything of a kind."""
        rows = [(name, "built in", "") for name in registry.builtin]
        for plugin in (found for found in installed(registry.kind) if found.package != OWN_PACKAGE):
            try:
                registry.loaded(plugin)
                rows.append((plugin.name, plugin.origin, ""))
            except InputError as error:
                rows.append((plugin.name, plugin.origin, f"error: {error}"))
        return rows

    say(LINE.format("kind", "name", "package", "").rstrip())
    for registry in (DATASETS, METHODS, PRESETS, SCORES, PROTOCOLS, EXPORTERS, COMMANDS):
        for name, package, error in found(registry):
            say(LINE.format(registry.kind, name, package, error).rstrip())
