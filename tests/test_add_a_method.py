"""docs/add_a_method.md: its method is complete. It trains, resumes, is scored, drawn, carried and exported."""

import json
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from plugin_packages import on_path, write_package

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import OWN, Config
from endoprior.core.config_io import to_dict
from endoprior.data import load_sequence
from endoprior.evaluation.registry import all_scores
from endoprior.evaluation.scoring import evaluate
from endoprior.model.method import METHODS, config_from, method_named, method_of
from endoprior.model.presets import preset, preset_names
from endoprior.model.scene_facts import SCENE_FORMAT
from endoprior.model.scene_file import load_scene
from endoprior.runs.train import train
from endoprior.system.arrays_file import save_arrays
from endoprior_studies.spec_file import load_spec

PAGE = Path(__file__).parents[1] / "docs" / "add_a_method.md"
BENCH = PAGE.parents[1] / "examples" / "own_bench.yaml"


@contextmanager
def registered(site: Path, change: tuple[str, str] = ("", "")) -> Iterator[None]:
    """The page's methods, registered as the page says; with a text in the code of the loss replaced."""
    (entries,) = re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    examples = PAGE.parents[1] / "examples"
    code = {
        name: (examples / f"{name}.py").read_text(encoding="utf-8")
        for name in ("linear_method", "own_loss", "own_score")
    }
    assert all(len(text.splitlines()) < 100 for text in code.values()) and change[0] in code["own_loss"]
    code["own_loss"] = code["own_loss"].replace(*change) if change[0] else code["own_loss"]
    groups = tomllib.loads(entries)["project"]["entry-points"]
    named = {group.removeprefix("endoprior."): targets for group, targets in groups.items()}
    write_package(site, "of-the-page", named, **code)
    with on_path(site):
        yield


def test_the_package_of_the_page_installs_as_the_page_says(tmp_path):
    text = PAGE.read_text(encoding="utf-8")
    (project,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    (copied,) = re.findall(r"^cp (.*) own/$", text, re.MULTILINE)
    own = tmp_path / "own"
    own.mkdir()
    (own / "pyproject.toml").write_text(project, encoding="utf-8")
    for file in copied.split():
        shutil.copy(PAGE.parents[1] / file, own)
    offline = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--disable-pip-version-check"]
    words = [sys.executable, "-m", "pip", "install", *offline, "--target", str(tmp_path / "site"), str(own)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with on_path(tmp_path / "site"):
        assert {"linear", "own-loss"} <= {*preset_names()} and "area_error" in all_scores()
        assert preset("own-loss").method == "own-loss" and method_named("linear").motion is not None


def test_a_benchmark_says_that_the_package_of_a_method_is_missing(tmp_path, capsys):
    plugin = "nstall the package with this plugin; `endoprior plugins` lists what is installed."
    assert main(["bench", str(BENCH), str(tmp_path / "out")]) == 2
    text = capsys.readouterr().err
    assert "methods.own-loss.preset: expected one of default, " in text
    assert f"got 'own-loss', which no installed package has. Fix: I{plugin}" in text
    spec = yaml.safe_load(BENCH.read_text(encoding="utf-8"))
    spec |= {"methods": {"default": {"preset": "defualt"}}, "claims": []}
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(spec))
    assert main(["bench", str(tmp_path / "spec.yaml"), str(tmp_path / "out")]) == 2
    assert f"Fix: I{plugin} Did you mean `default`?" in capsys.readouterr().err
    spec["methods"]["default"]["preset"] = "default"
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(spec))
    assert main(["bench", str(tmp_path / "spec.yaml"), str(tmp_path / "out")]) == 2
    text = capsys.readouterr().err
    assert "got 'area_error'. Fix: See docs/scores.md, or i" in text and plugin in text


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


@pytest.mark.slow
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
        (("cfg.areas_weight * areas(forward)", "0.0"), r"loss term areas: expected .* got a float\. Fix: "),
        (('{"areas"', '{"track"'), r"loss term track: expected a name of its own.* Fix: Rename it\."),
    ],
)
def test_a_wrong_loss_is_one_line_with_a_fix_that_its_author_can_follow(tiny_sequence, tmp_path, change, message):
    with registered(tmp_path / "site", change), pytest.raises(InputError, match=message) as caught:
        train(load_sequence(tiny_sequence), preset("own-loss", iterations=4, gaussians=200))
    assert "\n" not in str(caught.value)


def test_a_scene_whose_plugin_is_missing_names_what_to_install(tmp_path):
    about = {"config": {"method": "elsewhere"}}
    save_arrays(tmp_path / "scene.safetensors", {"x": torch.zeros(1)}, about, SCENE_FORMAT)
    with pytest.raises(InputError) as caught:
        load_scene(tmp_path)
    said = str(caught.value)
    assert said.startswith(f"{tmp_path / 'scene.safetensors'}: method: expected one of ") and "got 'elsewhere'" in said
    assert said.count("Fix: ") == 1 and "Fix: Install the package with this plugin; " in said


def test_the_worked_example_loads_and_its_score_is_that_of_means(tmp_path, tiny_sequence):
    with registered(tmp_path / "site"):
        spec = load_spec(BENCH)
        assert set(spec.methods) == {"default", "own-loss", "deform3dgs", "endogaussian"} and len(spec.seeds) == 3
        sequence = load_sequence(tiny_sequence)
        scene = train(sequence, preset("own-loss", iterations=4, gaussians=200))
        score = evaluate(scene, sequence, networks=False).scores["area_error"]
        frames = [sequence.frame(i) for i in range(len(sequence)) if (i - 1) % 8 == 0]
        found = [_area_error(scene.render(frame.time).color.numpy(), frame) for frame in frames]
        assert score == pytest.approx(np.mean(found), abs=0.2)  # scores are of 8 bits


def _area_error(image: np.ndarray, frame) -> float:
    """The score as a loop over squares, in percent."""
    errors = []
    for y in range(0, frame.rgb.shape[0] - 7, 8):
        for x in range(0, frame.rgb.shape[1] - 7, 8):
            square = slice(y, y + 8), slice(x, x + 8)
            if frame.tissue_mask[square].all():
                errors.append(np.abs(image[square].mean((0, 1)) - frame.rgb[square].mean((0, 1))))
    return 100 * float(np.mean(errors))


@pytest.mark.slow
def test_the_worked_example_runs_to_its_figure(tmp_path):
    small = yaml.safe_load(BENCH.read_text(encoding="utf-8"))
    small |= {"seeds": [0], "set": {"iterations": 12}, "claims": []}
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(small))
    with registered(tmp_path / "site"):
        assert main(["bench", str(tmp_path / "small.yaml"), str(tmp_path / "out"), "--cores", "1"]) == 0
    cells = json.loads((tmp_path / "out" / "results.json").read_text())["cells"]
    assert {cell["method"] for cell in cells} == {"default", "own-loss", "deform3dgs", "endogaussian"}
    assert all(cell["scores"]["area_error"] > 0 for cell in cells)
    assert (tmp_path / "out" / "figures" / "frames-phantom.png").exists()


def test_every_method_can_be_found_and_names_itself():
    for name in METHODS.names():
        assert isinstance(method_named(name).config_type(), Config)
    for name in preset_names():
        cfg = preset(name)
        assert cfg.method in (name.removesuffix("-published"), OWN) and config_from(to_dict(cfg)) == cfg
    with pytest.raises(InputError, match="method: expected one of"):
        method_of(Config(method="nerf"))
