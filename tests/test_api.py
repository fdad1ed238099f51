"""The public Python API: README's block as it stands, in any order of imports, with types."""

from __future__ import annotations

import ast
import itertools
import re
import subprocess
import sys
from pathlib import Path

import pytest

import endoprior

ROOT = Path(__file__).parents[1]
PACKAGE = Path(endoprior.__file__).parent
SHORT = """
import endoprior
full = endoprior.preset
endoprior.preset = lambda name, **changes: full(name, gaussians=200, **changes)
"""
"""Runs before README's block: the same preset with few Gaussians."""


@pytest.mark.slow
def test_readmes_python_block_runs_as_it_stands(tiny_sequence, tmp_path):
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert '"DATA"' in block and '"RUN"' in block
    checks = 'assert view.color.shape == (40, 48, 3) and "psnr" in scores and len(splats.means)\n'
    checks += "assert len(losses) == 3 and scene.config.optim.decay_iterations == 3 and scene.config.seed == 1\n"
    script = tmp_path / "readme.py"
    block = block.replace("iterations=3000", "iterations=3")
    script.write_text(SHORT + block.replace("DATA", str(tiny_sequence)).replace("RUN", str(tmp_path / "run")) + checks)
    done = subprocess.run([sys.executable, script], check=True, capture_output=True, text=True)
    assert not done.stdout and not done.stderr  # progress is for terminals and notebooks


def test_no_import_replaces_a_public_name():
    """`from endoprior.train import ...` once turned `endoprior.train` into a module."""
    homes = sorted(set(endoprior.HOMES.values()))
    imports = [f"import endoprior.{home}" for home in homes]
    check = "import endoprior; assert all(callable(getattr(endoprior, n)) for n in endoprior.__all__)"
    forget = "import sys; [sys.modules.pop(name) for name in [*sys.modules] if name.split('.')[0] == 'endoprior']"
    lines = [*imports[::-1], check, forget, *itertools.chain(*((check, line) for line in imports)), check]
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True)


def test_no_module_below_the_package_has_a_public_name():
    modules = {path.stem for path in PACKAGE.iterdir()}
    assert not modules & set(endoprior.__all__)


def test_public_names_are_typed_and_listed_once():
    assert (PACKAGE / "py.typed").is_file()
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (guarded,) = (node for node in tree.body if isinstance(node, ast.If))
    typed = {alias.name: node.module for node in guarded.body for alias in node.names}
    assert typed == endoprior.HOMES and sorted(typed) == endoprior.__all__ == dir(endoprior)
