"""A new score, layout or export format is one new file and one line of a registry: the documents' examples, tried."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plugin_packages import entry_points, write_package

import endoprior
from endoprior.data import load_sequence
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.presets import preset
from endoprior.model.scene import Scene, SingleScene

SOURCES, DOCS = Path(endoprior.__file__).parents[1], Path(__file__).parents[1] / "docs"
EXAMPLE = DOCS.parent / "examples" / "endoprior_example" / "endoprior_example"
EVALUATE = """
import sys
from dataclasses import replace
import torch
from endoprior import evaluate, load_scene, load_sequence
from endoprior_studies.results import Results
from endoprior_studies.spec import Cell, MethodSpec, SequenceSpec, Spec
from endoprior_studies.tables import markdown, score_table
from endoprior.model.gaussians import Offsets


class Static:
    def offsets(self, means, time, ops):
        return Offsets(torch.zeros_like(means))


scene = replace(load_scene(sys.argv[1]), field=Static())  # so that no kernel has to be compiled
scores = evaluate(scene, load_sequence(sys.argv[2]), networks=False).scores
spec = Spec("t", {"s": SequenceSpec(path="s")}, {"m": MethodSpec()}, scores=("mae",))
print(scores["mae"])
print(markdown(score_table(Results(spec, {Cell("s", "m", None, 0): scores}), "s")))
"""
LOAD = """
import sys
from endoprior import load_sequence
from endoprior.core.config import DataConfig

for name in ("auto", "rendered"):
    sequence = load_sequence(sys.argv[1], DataConfig(format=name))
    print(name, len(sequence), *sequence.frame(3).rgb_u8.shape)
"""
EXPORT = """
import sys
from endoprior.cli import main

assert main(["export", *sys.argv[1:], "--format", "xyz", "--canonical"]) == 0
main(["export", "--help"])
"""


@pytest.fixture
def extend(tmp_path):
    """Copies the package, and adds a file and a line to the copy."""

    def add(page: str, module: str, registry: str, variable: str, entry: str = '"{}"', opening: str = "(") -> None:
        shutil.copytree(SOURCES, tmp_path / "src", ignore=shutil.ignore_patterns("*.nb?", "*.ready", "*.egg-info"))
        write_package(tmp_path / "src", "endoprior", entry_points(SOURCES.parent))
        example = (DOCS / page).read_text(encoding="utf-8").split("\n## Add a ")[1]
        file = tmp_path / "src" / "endoprior" / module
        assert f"{file.parent.name}/NAME.py" in example and registry in example
        linked, shown = EXAMPLE / file.name, re.search(r"```python\n(.*?)```", example, re.DOTALL)
        assert shown or f"[{file.name}](" in example
        file.write_text(shown[1] if shown else linked.read_text(encoding="utf-8"))
        lines = (tmp_path / "src" / "endoprior" / registry).read_text()
        start = f"{variable} = {opening}\n"
        assert start in lines
        added = lines.replace(start, f"{start}    {entry.format(file.stem)},\n")
        (tmp_path / "src" / "endoprior" / registry).write_text(added)

    return add


def run(tmp_path: Path, *words: str | Path) -> str:
    """What Python prints with the extended copy."""
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "src")}
    command = [sys.executable, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    return done.stdout


def tiny_scene(folder: Path) -> Scene:
    """Twenty Gaussians before the camera of a sequence, rendered by the reference backend."""
    sequence = load_sequence(folder)
    cfg = preset("default").fitted(len(sequence))
    cfg = replace(cfg, render=replace(cfg.render, backend="reference"))
    points = np.random.default_rng(0).uniform([-10, -8, 55], [10, 8, 65], (20, 3)).astype(np.float32)
    gaussians = create_gaussians(points, np.full((20, 3), 0.5, np.float32), np.zeros(20, np.float32), cfg)
    cameras = tuple(sequence.camera(i) for i in range(len(sequence)))
    return SingleScene(gaussians, None, cfg, cameras, 15.0, torch.zeros(20), torch.zeros(20))


@pytest.mark.slow
def test_a_new_score_is_computed_and_stands_in_tables(extend, tmp_path, make_tiny_sequence):
    extend("scores.md", "evaluation/scorers/mae.py", "evaluation/registry.py", "SCORERS")
    data = make_tiny_sequence(num_frames=3)
    tiny_scene(data).save(tmp_path / "scene.safetensors")
    value, *table = run(tmp_path, "-c", EVALUATE, tmp_path / "scene.safetensors", data).splitlines()
    assert 0 < float(value) < 100
    assert table[0] == "| method | mean absolute error, % |" and table[2] != "| m | - |"


def test_a_new_layout_is_recognized_and_opened(extend, tmp_path, tiny_sequence):
    extend("datasets.md", "data/rendered.py", "data/formats.py", "FORMATS")
    shutil.copytree(tiny_sequence / "images", tmp_path / "new" / "rgb")
    (tmp_path / "new" / "depth").mkdir()
    for image in sorted((tmp_path / "new" / "rgb").iterdir()):
        np.save(tmp_path / "new" / "depth" / f"{image.stem}.npy", np.full((40, 48), 60, np.float32))
    assert run(tmp_path, "-c", LOAD, tmp_path / "new").splitlines() == ["auto 17 40 48 3", "rendered 17 40 48 3"]


@pytest.mark.slow
def test_a_new_export_format_is_offered_and_written(extend, tmp_path, tiny_sequence):
    extend("export.md", "export/xyz.py", "export/formats.py", "FORMATS", '"{0}": "{0}:FORMAT"', "{")
    scene = tiny_scene(tiny_sequence)
    scene.save(tmp_path / "scene.safetensors")
    said = run(tmp_path, "-c", EXPORT, tmp_path / "scene.safetensors", tmp_path / "a.xyz")
    assert np.loadtxt(tmp_path / "a.xyz") == pytest.approx(scene.gaussians["means"].detach().numpy(), abs=1e-4)
    assert "xyz" in said[said.index("usage:") :]
