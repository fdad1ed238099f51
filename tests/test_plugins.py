"""Plugins: what is found, what is rejected and how it is said, and that a broken one breaks nothing else."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from plugin_packages import EXAMPLE, entry_points, on_path, write_package

from endoprior import evaluate, load_sequence
from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data.formats import REGISTRY as DATASETS
from endoprior.evaluation.registry import REGISTRY as SCORES
from endoprior.evaluation.registry import all_scores
from endoprior.export.formats import REGISTRY as EXPORTERS
from endoprior.model.method import METHODS
from endoprior.model.presets import PRESETS
from endoprior_studies.method import method_named as bench_method

GOOD_SCORE = """
from endoprior.evaluation.score import Score
SCORES = (Score("extra", "extra", "", True, 1, "Always 7."),)
def compute(context):
    context.add("extra", 7.0)
"""


class Truth:
    """A reconstruction without error: the frames themselves, and no depth."""

    def __init__(self, sequence):
        self.sequence = sequence

    def render(self, index):
        return np.clip(self.sequence.frame(index).rgb + np.float32(0.01), 0, 1), None


@pytest.fixture
def install(tmp_path):
    """Puts a package on the path for the rest of the test."""
    with ExitStack() as stack:

        def add(groups, name="other-pkg", **modules):
            write_package(tmp_path / f"site-{name}", name, groups, **modules)
            stack.enter_context(on_path(tmp_path / f"site-{name}"))

        yield add


def problems(capsys) -> list[str]:
    return [line for line in capsys.readouterr().err.splitlines() if line]


@pytest.mark.parametrize(
    ("registry", "source", "said"),
    [
        (DATASETS, "import absent_library", "ModuleNotFoundError: No module named 'absent_library'"),
        (DATASETS, "x = (", "SyntaxError"),
        (DATASETS, "raise SystemExit(3)", "SystemExit: 3"),
        (DATASETS, "", "expected a DatasetFormat of endoprior.data.formats, got an object of type module"),
        (EXPORTERS, "", "expected an ExportFormat of endoprior.export.formats, got an object of type module"),
        (METHODS, "options = {}\ndef train(): pass", "got options of type dict"),
        (METHODS, "from endoprior import Config\noptions = Config()", "got no function train"),
        (SCORES, "", "got SCORES of type NoneType"),
        (SCORES, GOOD_SCORE.replace("compute", "run"), "got no function compute"),
        (SCORES, GOOD_SCORE.replace('"extra"', '"psnr"'), "got another score psnr, which is built in"),
    ],
)
def test_a_plugin_that_is_not_what_it_promises_is_named(install, capsys, registry, source, said):
    install({registry.kind: {"mine": "bad_module"}}, bad_module=source)
    assert registry.names() == (*registry.builtin, "mine")
    with pytest.raises(InputError, match=r"^plugin mine of other-pkg 1\.0 \(bad_module\): expected ") as caught:
        registry.load("mine")
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert main(["plugins"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if " mine " in line]
    assert line.startswith(registry.kind) and "other-pkg 1.0" in line and said in line


@pytest.mark.parametrize(
    ("bad", "place"),
    [
        ("x = 1\nraise RuntimeError('no')", "bad_module.py:2"),
        ("import helper_of_others\n\nhelper_of_others.fail()", "bad_module.py:3"),
        ("def broken(:", "bad_module.py:1"),
    ],
)
def test_the_place_in_the_plugins_own_code_is_named(install, tmp_path, bad, place):
    helper = "def fail():\n    raise RuntimeError('no')"
    install({"scores": {"mine": "bad_module"}}, bad_module=bad, helper_of_others=helper)
    with pytest.raises(InputError) as caught:
        SCORES.load("mine")
    assert f"({tmp_path / 'site-other-pkg' / place}). Fix: Update" in str(caught.value)


@pytest.mark.parametrize(
    ("registry", "name"), [(DATASETS, "endonerf"), (DATASETS, "auto"), (METHODS, "endogs"), (PRESETS, "default")]
)
def test_built_in_names_stay_built_in(install, capsys, registry, name):
    install({registry.kind: {name: "bad_module"}}, bad_module="raise RuntimeError('imported')")
    assert registry.names() == registry.builtin and {used for used, _ in registry.usable()} <= {*registry.builtin}
    (line,) = problems(capsys)  # reported once, though asked twice
    assert f"plugin {name} of other-pkg 1.0" in line and "got that of a built-in one" in line
    if name != "auto":
        assert registry.origin(name) == "" and registry.load(name)


def test_one_name_in_two_packages_is_neither(install, capsys):
    for package in ("a-pkg", "b-pkg"):
        install({"scores": {"mine": "good_module"}}, package, good_module=GOOD_SCORE)
    assert "mine" not in SCORES.names()
    assert all("one name in a-pkg, b-pkg" in line for line in problems(capsys))


def test_of_two_equal_scores_the_second_is_left_out(install, capsys):
    install({"scores": {"first": "good_module", "second": "good_module"}}, good_module=GOOD_SCORE)
    assert "extra" in all_scores()
    assert problems(capsys) == ["endoprior: second of other-pkg 1.0 is left out: another plugin has the score extra"]


def test_broken_plugins_break_no_other_command(install, capsys, tiny_sequence, tmp_path):
    broken = {kind: {"mine": "bad_module"} for kind in ("datasets", "methods", "scores", "exporters")}
    install(broken, bad_module="import absent_library")
    shutil.copytree(tiny_sequence / "images", tmp_path / "plain" / "images")
    sequence = load_sequence(tmp_path / "plain")  # the last layout: all others are asked before
    result = evaluate(Truth(sequence), sequence, networks=False)
    evaluate(Truth(sequence), sequence, networks=False)
    assert "psnr" in result.scores and not {"mine"} & result.skipped.keys()
    lines = problems(capsys)
    assert len(lines) == 2 and all("absent_library" in line for line in lines)  # dataset and score, once each
    assert main(["check", str(tiny_sequence), "--data.format", "mine"]) == 2
    (line,) = problems(capsys)
    assert line.startswith("endoprior: plugin mine of other-pkg 1.0 (bad_module): expected a DatasetFormat")


def test_errors_inside_plugins_cost_their_own_part(install, capsys, tiny_sequence, tmp_path):
    layout = """
from endoprior.data.formats import DatasetFormat
FORMAT = DatasetFormat(lambda path: 1 / 0, None)
"""
    score = GOOD_SCORE.replace('    context.add("extra", 7.0)', '    context.add("extra", {}["key"])')
    install({"datasets": {"mine": "a_layout:FORMAT"}, "scores": {"mine": "a_score"}}, a_layout=layout, a_score=score)
    shutil.copytree(tiny_sequence / "images", tmp_path / "plain" / "images")
    sequence = load_sequence(tmp_path / "plain")
    (line,) = problems(capsys)
    assert line.startswith("endoprior: mine of other-pkg 1.0 failed: ZeroDivisionError: division by zero (")
    assert line.endswith("a_layout.py:3)")
    result = evaluate(Truth(sequence), sequence, networks=False)
    assert "psnr" in result.scores
    assert result.skipped["extra"].startswith("mine of other-pkg 1.0 failed: KeyError: 'key' (")
    assert result.skipped["extra"].endswith("a_score.py:5)")


def test_scores_of_a_plugin_are_computed_and_known(install, tiny_sequence):
    install({"scores": {"mine": "good_module"}, "datasets": {"mine": "good_module:ABSENT"}}, good_module=GOOD_SCORE)
    sequence = load_sequence(tiny_sequence)
    assert evaluate(Truth(sequence), sequence, networks=False).scores["extra"] == 7
    assert all_scores()["extra"].label == "extra"
    with pytest.raises(InputError, match=r"has no attribute 'ABSENT'\. Fix: Update or uninstall other-pkg"):
        DATASETS.load("mine")


def test_typos_list_the_plugins(install, capsys, tiny_sequence):
    install({"datasets": {"mine": "bad_module"}, "exporters": {"mine": "bad_module"}}, bad_module="")
    assert main(["check", str(tiny_sequence), "--data.format", "min"]) == 2
    assert "data.format: expected one of auto, scared, c3vd" in (said := capsys.readouterr().err) and "mine" in said
    assert main(["export", "RUN", "OUT", "--format", "min"]) == 2
    assert "html,mine" in capsys.readouterr().err.replace(" ", "").replace("'", "")


def test_nothing_is_imported_before_it_is_used(install, tiny_sequence):
    install({"datasets": {"mine": "bad_module"}, "scores": {"mine": "bad_module"}}, bad_module="raise RuntimeError")
    assert len(load_sequence(tiny_sequence, DataConfig())) == 17  # recognized before any plugin is asked
    assert "bad_module" not in sys.modules and "mine" in SCORES.names()


def test_the_page_names_every_file_of_the_example():
    """Whole files, which the tests of the example import and use; of pyproject.toml a part."""
    page = (EXAMPLE.parents[1] / "docs" / "plugins.md").read_text(encoding="utf-8")
    assert all(f"[{file.name}](" in page for file in EXAMPLE.glob("endoprior_example/[!_]*.py"))
    (entry,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert re.sub(r" +#.*", "", entry).strip() in (EXAMPLE / "pyproject.toml").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_examples_own_tests_pass(tmp_path):
    write_package(tmp_path, "endoprior-example", entry_points(EXAMPLE))
    with on_path(EXAMPLE, tmp_path):
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(EXAMPLE / "tests")]
        done = subprocess.run(command, capture_output=True, text=True, cwd=EXAMPLE)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_the_example_can_be_installed(tmp_path):
    pytest.importorskip("setuptools", reason="pip builds packages with setuptools, which is not here")
    shutil.copytree(EXAMPLE, tmp_path / "source", ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "--target", str(tmp_path / "site"), str(tmp_path / "source")], check=True)
    with on_path(tmp_path / "site"):
        assert all("endoprior-example 0.1.0" in registry.origin(name) for registry, name in (
            (DATASETS, "rendered"), (METHODS, "nearest-frame"), (SCORES, "mae"), (EXPORTERS, "transforms")
        ))  # fmt: skip
        assert Path(bench_method("nearest-frame").__file__).is_relative_to(tmp_path / "site")
