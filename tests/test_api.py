"""The public Python API: README's block as it stands, in any order of imports, with types."""

from __future__ import annotations

import ast
import doctest
import inspect
import itertools
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

import endoprior
from endoprior.core.types import RenderedView

ROOT = Path(__file__).parents[1]
PACKAGE = Path(endoprior.__file__).parent
CALLABLE = {"export": "export", "phantom": "write_phantom", "prepare": "prepare"}
"""Packages with a public name -> their function."""
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


def test_a_wrong_call_names_what_was_called(tmp_path):
    for call, said in (
        (lambda: endoprior.phantom(tmp_path / "out", frames=12), "got an unexpected keyword argument 'frames'"),
        (endoprior.phantom, "missing a required argument: 'out'"),
    ):
        with pytest.raises(TypeError) as caught:
            call()
        assert str(caught.value) == f"endoprior.phantom(out, cfg, progress): {said}"
    assert [*inspect.signature(endoprior.export).parameters] == ["scene", "out", "options", "progress"]


FUNCTIONS = {name for name in endoprior.__all__ if not inspect.isclass(getattr(endoprior, name))}
CHAIN = ("phantom", "train")
"""Functions whose examples write what the others open, DATA and RUN."""


@pytest.fixture(scope="module")
def examples_folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("examples")


@pytest.mark.parametrize("name", [*CHAIN, *sorted(FUNCTIONS - {*CHAIN})])
def test_the_example_of_a_public_function_runs(name, examples_folder, monkeypatch, capsys):
    monkeypatch.chdir(examples_folder)
    function = getattr(endoprior, name)
    (example,) = doctest.DocTestFinder(recurse=False).find(inspect.unwrap(function), name, globs={})
    assert example.examples, f"{name} has no example"
    result = doctest.DocTestRunner().run(example)
    assert not result.failed, capsys.readouterr().out


def test_a_sequence_is_indexed_iterated_and_printed(tiny_sequence):
    sequence = endoprior.load_sequence(tiny_sequence)
    assert [frame.index for frame in sequence] == list(range(len(sequence)))
    assert sequence[0] is sequence.frame(0) and sequence[-1].index == len(sequence) - 1
    assert [frame.index for frame in sequence[1:7:3]] == [1, 4]
    with pytest.raises(IndexError):
        sequence[len(sequence)]
    assert re.fullmatch(r"FrameSequence\('.*': \d+ frames \(.* test\), 48x40, 15 .*, depth in mm\)", repr(sequence))
    part = repr(sequence.part(0, 2))
    assert "2 frames (1 train, 1 test)" in part and "\n" not in part


def test_expected_depth_is_divided_by_alpha():
    depth, alpha = torch.tensor([[20.0, 0.0]]), torch.tensor([[0.5, 0.0]])
    assert RenderedView(torch.zeros(1, 2, 3), depth, alpha).expected_depth.tolist() == [[40.0, 0.0]]


def test_no_module_below_the_package_has_a_public_name():
    modules = {path.stem for path in PACKAGE.iterdir()}
    assert modules & set(endoprior.__all__) == set(CALLABLE)


def test_a_package_with_a_public_name_can_be_called():
    """However it is imported first; one process, in which the package is forgotten between two ways."""
    code = """
import inspect, sys
for name, function in CALLABLE.items():
    for first in ("", f"import endoprior.{name}", f"from endoprior.{name} import {function}"):
        for module in [each for each in sys.modules if each.split(".")[0] == "endoprior"]:
            del sys.modules[module]
        exec(f"import endoprior; {first}")
        package = getattr(sys.modules["endoprior"], name)
        expected = getattr(package, function)
        assert inspect.ismodule(package) and package.__wrapped__ is expected, (name, first)
        assert inspect.signature(package) == inspect.signature(expected), (name, first)
"""
    subprocess.run([sys.executable, "-c", code.replace("CALLABLE", repr(CALLABLE))], check=True)


def test_the_version_is_that_of_the_installation():
    assert endoprior.__version__ == version("endoprior")


def test_public_names_are_typed_and_listed_once():
    assert (PACKAGE / "py.typed").is_file()
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (guarded,) = (node for node in tree.body if isinstance(node, ast.If))
    typed = {
        alias.asname or alias.name: node.module
        for node in guarded.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert typed == endoprior.HOMES and sorted(typed) == endoprior.__all__ == dir(endoprior)
