"""Where Numba keeps compiled kernels: beside the package, in the home folder, or in `NUMBA_CACHE_DIR`."""

from __future__ import annotations

import os
from pathlib import Path

from .checks import InputError, input_error


def without_kernel_cache(error: BaseException) -> InputError | None:
    """The error for the user if Numba found no folder for compiled kernels, which it raises at an import; else None."""
    if not (isinstance(error, RuntimeError) and "no locator available" in str(error)):
        return None
    package, home, chosen = Path(__file__).parents[1], os.path.expanduser("~"), os.environ.get("NUMBA_CACHE_DIR")
    got = f"none that can be written: {f'not {chosen}, ' if chosen else ''}not {package}, not {home}"
    fix = "`export NUMBA_CACHE_DIR=FOLDER`, one that is yours alone; kernels are compiled there once."
    return input_error("NUMBA_CACHE_DIR", "a folder for compiled kernels", got, fix)
