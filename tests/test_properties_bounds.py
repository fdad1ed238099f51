"""No kernel reads or writes outside its arrays: the generated inputs again, under Numba's bounds checks.

Kernels run without these checks otherwise. They are all compiled anew here, which takes minutes. Vector loads and
stores (`simd`) are not checked.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
PARTS = ("render", "density", "losses", "geometry", "sampling", "adam")


@pytest.mark.slow
def test_kernels_stay_inside_their_arrays(tmp_path):
    settings = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    files = [str(HERE / f"test_properties_{name}.py") for name in PARTS]
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, cwd=HERE, env=os.environ | settings, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:]
