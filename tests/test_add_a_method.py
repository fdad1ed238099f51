"""docs/add_a_method.md: its method is complete. It trains, resumes, is scored, drawn, carried and exported."""

import re
import sys
from pathlib import Path

import pytest
import torch

from endoprior.core import methods
from endoprior.core.checks import InputError
from endoprior.core.config import Config
from endoprior.core.config_io import from_dict, to_dict
from endoprior.core.presets import preset
from endoprior.data import load_sequence
from endoprior.evaluation.scoring import evaluate
from endoprior.model.scene_file import load_scene
from endoprior.runs.train import train

PAGE = Path(__file__).parents[1] / "docs" / "add_a_method.md"


@pytest.fixture
def linear(tmp_path, monkeypatch) -> Config:
    """The config of the page's method, registered as the page says."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(code.splitlines()) < 100
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "linear_of_the_page.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path / "page")
    monkeypatch.setitem(methods.METHODS, "linear", "linear_of_the_page")
    yield preset("linear", iterations=12, gaussians=200)
    sys.modules.pop("linear_of_the_page", None)


def test_the_method_of_the_page_is_complete(linear, tiny_sequence, tmp_path):
    sequence, losses = load_sequence(tiny_sequence), []
    scene = train(sequence, linear, tmp_path / "run", on_step=lambda report, trainer: losses.append(report.terms))
    assert scene.gaussians["velocities"].abs().max() > 1e-3 and "pull" in losses[-1]
    again = load_scene(tmp_path / "run")
    assert torch.equal(again.render(0.3).color, scene.render(0.3).color)
    shift = again.at(1.0).means - again.at(0.0).means
    torch.testing.assert_close(shift, again.gaussians["velocities"].detach(), rtol=1e-3, atol=1e-4)
    scores = evaluate(again, sequence, networks=False).scores
    assert {"psnr_tissue", "track_error_px"} & set(scores) and "num_gaussians" in scores
    resumed = train(sequence, linear, tmp_path / "run", resume=True)
    assert torch.equal(resumed.gaussians["velocities"], scene.gaussians["velocities"])


def test_the_line_of_the_page_is_that_of_the_table():
    (line,) = re.findall(r"```text\n(.*?)```", PAGE.read_text(), re.DOTALL)
    table = (Path(methods.__file__)).read_text()
    form = re.compile(r'^    "\w+": "endoprior\.methods\.\w+",$', re.MULTILINE)
    assert form.fullmatch(line.rstrip("\n")) and form.search(table)


def test_every_method_can_be_found_and_names_itself():
    for name in methods.METHODS:
        method = methods.method_named(name)
        cfg = method.config()
        assert cfg.method == name and from_dict(Config, to_dict(cfg)) == cfg
        if name != methods.OWN:
            assert preset(name) == cfg
    with pytest.raises(InputError, match="method: expected one of"):
        Config(method="nerf")
    with pytest.raises(InputError, match=r"init\.motion: expected rest with method endogs"):
        preset("default", method="endogs")
