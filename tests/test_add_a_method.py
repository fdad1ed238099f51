"""docs/add_a_method.md: its method is complete. It trains, resumes, is scored, drawn, carried and exported."""

import re
import signal
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
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
from endoprior.model.single_scene import FORMAT
from endoprior.runs.train import train
from endoprior.system.arrays_file import save_arrays

PAGE = Path(__file__).parents[1] / "docs" / "add_a_method.md"


@contextmanager
def registered(site: Path, change: tuple[str, str] = ("", "")) -> Iterator[None]:
    """The page's methods, registered as the page says; with a text in the code of the loss replaced."""
    (entries,) = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    examples = PAGE.parents[1] / "examples"
    code = {name: (examples / f"{name}.py").read_text(encoding="utf-8") for name in ("linear_method", "own_loss")}
    assert all(len(text.splitlines()) < 100 for text in code.values()) and change[0] in code["own_loss"]
    code["own_loss"] = code["own_loss"].replace(*change) if change[0] else code["own_loss"]
    groups = tomllib.loads(entries)["project"]["entry-points"]
    named = {group.removeprefix("endoprior."): targets for group, targets in groups.items()}
    write_package(site, "of-the-page", named, **code)
    with on_path(site):
        yield


@pytest.fixture
def linear(tmp_path) -> Iterator[Config]:
    """The config of the page's method that moves along lines."""
    with registered(tmp_path / "site"):
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


def test_an_own_loss_on_top_of_default_starts_from_flow_trains_resumes_and_loads(tiny_sequence, tmp_path):
    sequence, losses, moved = load_sequence(tiny_sequence), [], []
    with registered(tmp_path / "site"):
        cfg = preset("own-loss", iterations=12, gaussians=200)
        assert to_dict(preset("own-loss")) == to_dict(preset()) | {"method": "own-loss", "areas_weight": 0.5}
        assert cfg.init.motion == "flow" and config_from(to_dict(cfg)) == cfg
        for weight in (0.5, 0.0):
            run = cfg.replace({"areas_weight": weight})
            scene = train(sequence, run, tmp_path / f"{weight}", on_step=lambda report, _: losses.append(report.terms))
            assert torch.equal(load_scene(tmp_path / f"{weight}").render(0.3).color, scene.render(0.3).color)
            moved.append(scene.gaussians["motion"].detach())
        assert {"color", "areas", "track"} <= set(losses[0]) and losses[0]["areas"] > 0 == losses[-1]["areas"]
        stopped = tmp_path / "stopped"
        with pytest.raises(KeyboardInterrupt):
            train(sequence, cfg, stopped, on_step=lambda report, _: _stop_at(report.iteration, 6))
        done: list[int] = []
        resumed = train(sequence, cfg, stopped, resume=True, on_step=lambda report, _: done.append(report.iteration))
        assert done == list(range(7, 13)) and torch.equal(resumed.gaussians["motion"], moved[0])
    ours = train(sequence, preset(iterations=12, gaussians=200)).gaussians["motion"]
    assert torch.equal(ours, moved[1]) and not torch.equal(ours, moved[0])


def _stop_at(iteration: int, last: int) -> None:
    if iteration == last:
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("own_method import OwnMethod", "gaussian_method import GaussianMethod as OwnMethod"),
            r"init\.motion: expected rest .* got flow\. Fix: Set .*own_method\.Own",
        ),
        ((".abs().mean()", ".abs()"), r"loss term areas: expected .* got shape \(3, \d+, \d+\)\. Fix: Return its mean"),
        (("cfg.areas_weight * areas(drawn)", "0.0"), r"loss term areas: expected .* got a float\. Fix: "),
        (('{"areas"', '{"track"'), r"loss term track: expected a name of its own.* Fix: Rename it\."),
    ],
)
def test_a_wrong_loss_is_one_line_with_a_fix_that_its_author_can_follow(tiny_sequence, tmp_path, change, message):
    with registered(tmp_path / "site", change), pytest.raises(InputError, match=message) as caught:
        train(load_sequence(tiny_sequence), preset("own-loss", iterations=4, gaussians=200))
    assert "\n" not in str(caught.value)


def test_a_scene_whose_plugin_is_missing_names_what_to_install(tmp_path):
    about = {"config": {"method": "elsewhere"}}
    save_arrays(tmp_path / "scene.safetensors", {"x": torch.zeros(1)}, about, FORMAT)
    with pytest.raises(InputError) as caught:
        load_scene(tmp_path)
    said = str(caught.value)
    assert said.startswith(f"{tmp_path / 'scene.safetensors'}: method: expected one of ") and "got 'elsewhere'" in said
    assert said.count("Fix: ") == 1 and "Fix: Install the package with this plugin; " in said


def test_every_method_can_be_found_and_names_itself():
    for name in METHODS.names():
        assert isinstance(method_named(name).config_type(), Config)
    for name in preset_names():
        cfg = preset(name)
        assert cfg.method in (name.removesuffix("-published"), OWN) and config_from(to_dict(cfg)) == cfg
    with pytest.raises(InputError, match="method: expected one of"):
        method_of(Config(method="nerf"))
