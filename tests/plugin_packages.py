"""Packages with plugins, installed for the duration of a test: metadata in a folder that is put on the path."""

from __future__ import annotations

import os
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from endoprior.evaluation.registry import all_scores
from endoprior.model.method import method_named
from endoprior.system.plugins import installed, report
from endoprior_studies.method import method_named as bench_method

EXAMPLE = Path(__file__).parents[1] / "examples" / "endoprior_example"
Groups = dict[str, dict[str, str]]
"""Name -> target of each entry point, by kind."""


def write_package(site: Path, name: str, groups: Groups, **modules: str) -> None:
    """Install a package of version 1.0 by hand: its metadata, and modules by name and source."""
    metadata = site / f"{name.replace('-', '_')}-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = []
    for kind, entries in groups.items():
        lines += [f"[endoprior.{kind}]", *(f"{key} = {target}" for key, target in entries.items())]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")
    for module, source in modules.items():
        (site / f"{module}.py").write_text(source)


def entry_points(folder: Path) -> Groups:
    """The entry points of the package in a folder, as its pyproject.toml has them."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    return {group.removeprefix("endoprior."): entries for group, entries in project["entry-points"].items()}


@contextmanager
def on_path(*folders: Path) -> Iterator[None]:
    """Let this process and those it starts find the packages in `folders`."""
    before, variable, modules = list(sys.path), os.environ.get("PYTHONPATH"), set(sys.modules)
    names = [str(folder) for folder in folders]
    sys.path[:0] = names
    os.environ["PYTHONPATH"] = os.pathsep.join([*names, *([variable] if variable else [])])
    _forget()
    try:
        yield
    finally:
        sys.path[:] = before
        os.environ.pop("PYTHONPATH")
        if variable is not None:
            os.environ["PYTHONPATH"] = variable
        for module in set(sys.modules) - modules:
            if any((getattr(sys.modules[module], "__file__", None) or "").startswith(name) for name in names):
                del sys.modules[module]
        _forget()


def _forget() -> None:
    """Look for plugins anew."""
    for cached in (installed, report, all_scores, method_named, bench_method):
        cached.cache_clear()
