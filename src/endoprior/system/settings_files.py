"""Keep libraries from reading settings in the current folder: it may have come with the data.

Numba loads pickles from the `cache_dir` of `.numba_config.yaml`, and Matplotlib's `matplotlibrc` can start LaTeX. Both
look in the current folder first, and neither has an option against it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType, ModuleType
from typing import Any

NAMES = {"numba.core.config": b"'.numba_config.yaml'", "matplotlib": b"yield 'matplotlibrc'"}
"""Module -> the code in it that names the file in the current folder. An empty name in its place is never found."""


class _WithoutFile(SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType:
        name = NAMES[fullname]
        source = self.get_data(self.path).replace(name, name.split(b"'")[0] + b"''")
        return self.source_to_code(source, self.path)


class _Finder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in NAMES or not (spec := PathFinder.find_spec(fullname, path)):
            return None
        if isinstance(spec.loader, SourceFileLoader):
            spec.loader = _WithoutFile(fullname, spec.loader.path)
        return spec


def ignore_settings_of_current_folder() -> None:
    """Ignore them in what is imported from now on, and in Numba if it is imported already. Call it as often as needed.

    What Matplotlib has read before stays: then it is the settings of the program that imported it.
    """
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
    config: Any = sys.modules.get("numba.core.config")
    if config and getattr(config, "_config_fname", ""):
        config._config_fname, config.CACHE_DIR = "", os.environ.get("NUMBA_CACHE_DIR", "")
