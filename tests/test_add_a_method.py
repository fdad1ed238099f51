"""docs/add_a_method.md: its method is complete. It trains, resumes, is scored, drawn, carried and exported."""

import re
import tomllib
from pathlib import Path

import pytest
import torch
from plugin_packages import on_path, write_package

from endoprior.core.checks import InputError
from endoprior.core.config import OWN, Config
from endoprior.core.config_io import to_dict
from endoprior.data import load_sequence
from endoprior.evaluation.scoring import evaluate
from endoprior.model.method import METHODS, config_from, method_named, method_of
from endoprior.model.presets import preset, preset_names
from endoprior.model.scene_file import load_scene
from endoprior.runs.train import train

PAGE = Path(__file__).parents[1] / "docs" / "add_a_method.md"


@pytest.fixture
def linear(tmp_path, monkeypatch) -> Config:
    """The config of the page's method, registered as the page says."""
    (entries,) = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    code = (PAGE.parents[1] / "examples" / "linear_method.py").read_text(encoding="utf-8")
    assert len(code.splitlines()) < 100
    groups = tomllib.loads(entries)["project"]["entry-points"]
    named = {group.removeprefix("endoprior."): targets for group, targets in groups.items()}
    write_package(tmp_path / "site", "linear-of-the-page", named, linear_method=code)
    with on_path(tmp_path / "site"):
        yield preset("linear", iterations=12, gaussians=200)


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


def test_every_method_can_be_found_and_names_itself():
    for name in METHODS.names():
        assert isinstance(method_named(name).config_type(), Config)
    for name in preset_names():
        cfg = preset(name)
        assert cfg.method in (name.removesuffix("-published"), OWN) and config_from(to_dict(cfg)) == cfg
    with pytest.raises(InputError, match="method: expected one of"):
        method_of(Config(method="nerf"))
