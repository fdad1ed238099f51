"""Plugins: what packages add through entry points; docs/plugins.md. Our compared methods and studies are plugins too.

Nothing is imported before it is used. A plugin that cannot be used is reported once and left out; only a command that
asks for it by name ends with an error.
"""

from __future__ import annotations

import ast
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Generic, TypeVar

from ..core.checks import InputError, input_error
from .console import complain

T = TypeVar("T")
OWN_PACKAGE = "endoprior"
"""Its entry points are built in: no other package can have their names."""


class MissingPlugin(InputError):
    """A file needs a plugin that no installed package has. The file itself may be whole."""


@dataclass(frozen=True)
class Plugin:
    """An entry point of an installed package."""

    entry: EntryPoint
    package: str
    version: str

    @property
    def name(self) -> str:
        """What options and specs call it."""
        return self.entry.name

    @property
    def origin(self) -> str:
        """Package and version."""
        return f"{self.package} {self.version}"

    def rejected(self, expected: str, got: str, fix: str) -> InputError:
        """The error for this plugin, on one line."""
        subject = f"plugin {self.name} of {self.origin} ({self.entry.value})"
        return input_error(subject, expected, " ".join(got.split()), fix)

    def words_for(self, error: BaseException) -> str:
        """An error inside this plugin on one line: `KeyError: 'x' (FILE:LINE)`, the last place in its own package."""
        package = self.entry.module.partition(".")[0]
        frames = traceback.walk_tb(error.__traceback__)
        own = [(f, line) for f, line in frames if f.f_globals.get("__name__", "").partition(".")[0] == package]
        if isinstance(error, SyntaxError) and error.filename:  # raised before a frame of the file exists
            place = f" ({error.filename}:{error.lineno})"
        else:
            place = f" ({own[-1][0].f_code.co_filename}:{own[-1][1]})" if own else ""
        return " ".join(f"{type(error).__name__}: {error}{place}".split())


@cache
def installed(kind: str) -> tuple[Plugin, ...]:
    """The plugins of a kind, such as `methods`: entry points of the group `endoprior.KIND`, none of them imported."""
    found = [
        Plugin(entry, entry.dist.name, entry.dist.version)
        for entry in entry_points(group=f"endoprior.{kind}")
        if entry.dist
    ]
    return tuple(sorted(found, key=lambda plugin: (plugin.name, plugin.package)))


@cache
def report(error: str) -> None:
    """Print why a plugin cannot be used on stderr, once per process."""
    complain(f"endoprior: {error}")


@dataclass(frozen=True)
class Registry(Generic[T]):
    """Everything of one kind by name: what is built in, and what plugins add. Nothing is imported before it is used."""

    kind: str
    """See `installed`."""
    expected: str
    """What an entry point must stand for, for messages."""
    problem: Callable[[Any], str]
    """What is wrong with the object that an entry point stands for; empty if nothing is."""
    modules: tuple[str, ...] = ()
    """Built-in names that need no entry point."""
    load_module: Callable[[str], T] | None = None
    """Gives the one of such a name."""
    reserved: tuple[str, ...] = ()
    """Names with a meaning of their own, which no plugin can have."""

    @property
    def builtin(self) -> tuple[str, ...]:
        """The names that come with this package."""
        return (*self.modules, *(plugin.name for plugin in installed(self.kind) if plugin.package == OWN_PACKAGE))

    def names(self) -> tuple[str, ...]:
        """The built-in names, then those of plugins. Plugins whose name is taken are reported and left out."""
        return (*self.builtin, *(name for name in self._plugins() if name not in self.builtin))

    def load(self, name: str) -> T:
        """The one of that name in `names()`; InputError for a plugin that cannot be used, KeyError if there is none."""
        if name in self.modules and self.load_module:
            return self.load_module(name)
        return self.loaded(self._plugins()[name])

    def usable(self) -> Iterator[tuple[str, T]]:
        """Name and object of each entry point that can be used; the others are reported."""
        for name, plugin in self._plugins().items():
            try:
                yield name, self.loaded(plugin)
            except InputError as error:
                report(str(error))

    def origin(self, name: str) -> str:
        """Package and version that a plugin comes from; empty for what is built in."""
        return "" if name in self.builtin else self._plugins()[name].origin

    def documentation(self, name: str) -> str:
        """The docstring of a plugin's function, or of its module; it is read, not imported. Empty where there is none.

        To import all plugins only to list them would take seconds.
        """
        module, _, attribute = self._plugins()[name].entry.value.partition(":")
        try:
            spec = find_spec(module)
            tree = ast.parse(Path(spec.origin or "").read_text(encoding="utf-8")) if spec else ast.Module([], [])
        except (ImportError, OSError, ValueError, SyntaxError):
            return ""
        named = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == attribute]
        return ast.get_docstring(named[0] if named else tree) or ""

    def failure(self, name: str, error: Exception) -> str:
        """What to say of an error inside a plugin: `mae of endoprior-example 0.1 failed: KeyError: 'x' (mae.py:9)`."""
        plugin = self._plugins()[name]
        return f"{name} of {plugin.origin} failed: {plugin.words_for(error)}"

    def loaded(self, plugin: Plugin) -> T:
        """Import a plugin; InputError if its name is taken, importing it fails, or it is not what it should be."""
        self._demand_free_name(plugin)
        fix = f"update or uninstall {plugin.package}."
        try:
            found = plugin.entry.load()
            problem = self.problem(found)
        except (Exception, SystemExit) as error:  # code of others: anything can happen
            raise plugin.rejected(self.expected, plugin.words_for(error), fix) from error
        if problem:
            raise plugin.rejected(self.expected, problem, fix)
        return found

    def _plugins(self) -> dict[str, Plugin]:
        """The plugins by name; those whose name is taken are reported."""
        found = {}
        for plugin in installed(self.kind):
            try:
                self._demand_free_name(plugin)
            except InputError as error:
                report(str(error))
            else:
                found[plugin.name] = plugin
        return found

    def _demand_free_name(self, plugin: Plugin) -> None:
        if plugin.package == OWN_PACKAGE:
            return
        if plugin.name in (*self.builtin, *self.reserved):
            raise plugin.rejected("a name of its own", "that of a built-in one", f"uninstall {plugin.package}.")
        packages = [other.package for other in installed(self.kind) if other.name == plugin.name]
        if len(packages) > 1:
            got = f"one name in {', '.join(packages)}"
            raise plugin.rejected("a name of its own", got, "uninstall all but one.")
