"""What surrounds a command: variables, folders and files with which libraries fail, or read what is not ours.

Only the command line and the processes that it starts call this. `import endoprior` changes nothing of its process.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType, ModuleType
from typing import Any

from typing_extensions import override

from ..core.checks import input_error

MAX_THREADS = 1024
"""Numba crashes with very many."""
THREADING_LAYERS = ("default", "safe", "forksafe", "threadsafe", "tbb", "omp", "workqueue")


def set_up_process() -> None:
    """Set what libraries read when they are imported, and keep them from reading the current folder.

    Call it first in a process, as often as needed. A variable that the user set stays where it can.
    """
    # Idle torch threads spin on the cores that Numba needs, which makes rendering three times slower (docs/log.md).
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ["MPLBACKEND"] = "agg"  # figures are files; Matplotlib fails to import with one that it does not know
    # How many pixels OpenCV decodes at most (`data.reading.MAX_PIXELS`): what a header says twice, its decoders and
    # the readers of headers may understand differently.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", "64000000")
    warnings.filterwarnings("ignore", module=r"PIL\.\w+Plugin")  # of damaged tags, which are read as missing
    _ignore_settings_of_current_folder()


def reject_surroundings() -> None:
    """Raise InputError for a deleted working folder, an unknown home, and variables with which Numba fails."""
    try:
        os.getcwd()
    except OSError:
        fix = "`cd` to another one."
        raise input_error("the current folder", "a folder that exists", "one that was deleted", fix) from None
    if not os.path.isabs(home := os.path.expanduser("~")):  # libraries would keep their caches in the current folder
        fix = "`export HOME=FOLDER`, one that is yours alone."
        raise input_error("HOME", "an absolute path, for caches", "none" if home == "~" else repr(home), fix)
    threads = os.environ.get("NUMBA_NUM_THREADS", "1")
    if not (threads.isascii() and threads.isdigit() and 1 <= int(threads) <= MAX_THREADS):
        what = f"a number of threads, 1 to {MAX_THREADS}"
        raise input_error("NUMBA_NUM_THREADS", what, repr(threads), "`unset NUMBA_NUM_THREADS`.")
    layer = os.environ.get("NUMBA_THREADING_LAYER", "default")
    if layer not in THREADING_LAYERS:
        what = f"one of {', '.join(THREADING_LAYERS)}"
        raise input_error("NUMBA_THREADING_LAYER", what, repr(layer), "`unset NUMBA_THREADING_LAYER`.")


NAMES = {"numba.core.config": b"'.numba_config.yaml'", "matplotlib": b"yield 'matplotlibrc'"}
"""Module -> the code in it that names the file in the current folder. An empty name in its place is never found."""


class _WithoutFile(SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType:
        name, source = NAMES[fullname], self.get_data(self.path)
        file = name.split(b"'")[1].decode()
        if name not in source and os.path.exists(file):  # a release that looks for its file in another way
            raise input_error(file, "none in the current folder, which would be read", "one", "`cd` to another folder.")
        return self.source_to_code(source.replace(name, name.split(b"'")[0] + b"''"), self.path)


class _Finder(MetaPathFinder):
    @override
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in NAMES or not (spec := PathFinder.find_spec(fullname, path)):
            return None
        if isinstance(spec.loader, SourceFileLoader):
            spec.loader = _WithoutFile(fullname, spec.loader.path)
        return spec


def _ignore_settings_of_current_folder() -> None:
    """Keep libraries from reading settings in the current folder, which may have come with the data.

    Numba loads pickles from the `cache_dir` of `.numba_config.yaml`, and Matplotlib's `matplotlibrc` can start LaTeX.
    Both look in the current folder first, and neither has an option against it. This holds for what is imported from
    now on, and for Numba if it is imported already.

    What Matplotlib has read before stays: then it is the settings of the program that imported it.
    """
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
    config: Any = sys.modules.get("numba.core.config")
    if config and getattr(config, "_config_fname", ""):
        config._config_fname, config.CACHE_DIR = "", os.environ.get("NUMBA_CACHE_DIR", "")


SAFE_PATH = "PYTHONSAFEPATH"
"""As `-P`, for all Python processes."""


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module of this program in a process that is set up like this one.

    With `-P`, a file in the current folder, which may have come with the data, is not imported in place of a package.
    """
    return [sys.executable, "-P", "-m", "endoprior.system.run_module", module, *arguments]


@contextmanager
def without_current_folder() -> Iterator[None]:
    """Python processes that libraries start in this block do not import files of the current folder either."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        os.environ.pop(SAFE_PATH)
        if before is not None:
            os.environ[SAFE_PATH] = before
