"""What surrounds the command line: variables and folders with which libraries fail, or read what is not ours."""

from __future__ import annotations

import os

from ..core.checks import input_error

MOST_THREADS = 1024
"""Numba crashes with very many."""
THREADING_LAYERS = ("default", "safe", "forksafe", "threadsafe", "tbb", "omp", "workqueue")


def set_library_variables() -> None:
    """Set what libraries read when they are imported; a value of the user stays where it can."""
    # Idle torch threads spin on the cores that Numba needs, which makes rendering three times slower (docs/log.md).
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ["MPLBACKEND"] = "agg"  # figures are files; Matplotlib fails to import with one that it does not know


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
    if not (threads.isascii() and threads.isdigit() and 1 <= int(threads) <= MOST_THREADS):
        what = f"a number of threads, 1 to {MOST_THREADS}"
        raise input_error("NUMBA_NUM_THREADS", what, repr(threads), "`unset NUMBA_NUM_THREADS`.")
    layer = os.environ.get("NUMBA_THREADING_LAYER", "default")
    if layer not in THREADING_LAYERS:
        what = f"one of {', '.join(THREADING_LAYERS)}"
        raise input_error("NUMBA_THREADING_LAYER", what, repr(layer), "`unset NUMBA_THREADING_LAYER`.")
