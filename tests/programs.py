"""Other programs that open our files in tests, where they are installed; else the test is skipped with the command."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

BUILD = Path(__file__).parents[1] / "build"
SCRIPT = Path(__file__).with_name("read_in_blender.py")
BLENDER = (
    "NOT OPENED IN BLENDER: `python3.11 -m venv build/blender && build/blender/bin/pip install bpy==5.0.1`, "
    "or set ENDOPRIOR_BLENDER to a Blender, or to a Python with bpy"
)
WEB = (
    "NOT OPENED IN {}: `npm install --prefix build/web three@0.187.0 playcanvas@2.23.3`, "
    "or set ENDOPRIOR_NODE_MODULES to the folder node_modules"
)


def blender() -> str:
    """Blender, or a Python with its package bpy; empty where there is none."""
    own = BUILD / "blender/bin/python"
    return os.environ.get("ENDOPRIOR_BLENDER") or shutil.which("blender") or (str(own) if own.is_file() else "")


def open_in_blender(file: Path, folder: Path, frames: list[float], picture: str = "-") -> dict[str, np.ndarray]:
    """What Blender shows of `file` in these of its frames, as read_in_blender.py stores it in `folder`."""
    program = blender()
    if not program:
        pytest.skip(BLENDER)
    in_python = Path(program).name.startswith("python")
    options = [] if in_python else ["--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    out, asked = folder / "blender.npz", [str(frame) for frame in frames]
    command = [program, *options, str(SCRIPT), "--", str(file), str(out), picture, *asked]
    # The package of another Python finds none of ours.
    apart = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=apart)
    assert done.returncode == 0, done.stdout + done.stderr
    return dict(np.load(out))


def node_module(name: str) -> Path:
    """The folder of an npm package."""
    folder = Path(os.environ.get("ENDOPRIOR_NODE_MODULES") or BUILD / "web/node_modules") / name
    if not folder.is_dir():
        pytest.skip(WEB.format(name))
    return folder
