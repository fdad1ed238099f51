"""No kernel reads or writes outside its arrays: the generated inputs again, under Numba's bounds checks.

Kernels have no such checks in use. All are compiled anew for it, which takes minutes: in thorough runs only. Vector
loads and stores (`simd`) are not checked.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis_profiles import THOROUGH

HERE = Path(__file__).parent
FILES = ("render", "density", "losses", "geometry", "sampling", "adam")


@pytest.mark.skipif(not THOROUGH, reason="compiles every kernel again: set ENDOPRIOR_HYPOTHESIS=thorough")
@pytest.mark.parametrize("name", FILES)
def test_kernels_stay_inside_their_arrays(name, tmp_path_factory):
    cache = tmp_path_factory.getbasetemp() / "checked_kernels"
    settings = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(cache), "ENDOPRIOR_HYPOTHESIS": "suite"}
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(HERE / f"test_properties_{name}.py")]
    done = subprocess.run(command, cwd=HERE, env=os.environ | settings, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:]
