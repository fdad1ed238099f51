"""`endoprior train --resume RUN` and `--config FILE`: what a run starts from."""

import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import pytest

import endoprior
from endoprior.cli import main
from endoprior.cli.train import Train
from endoprior.core.checks import InputError
from endoprior.model.presets import preset
from endoprior.runs.folder import config_of_run, read_config

QUICK = [
    "--preset", "paper", "--seed", "3", "--init-budget", "200", "--schedule.coarse-iterations", "2",
    "--schedule.fine-iterations", "12", "--deformation.hexplane.multires", "1",
    "--deformation.hexplane.channels", "4", "--deformation.hexplane.time-resolution", "6", "--no-networks",
]  # fmt: skip


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A sequence, the run folder of an interrupted training on it, and the file of an uninterrupted one."""
    from conftest import write_tiny_sequence

    folder = tmp_path_factory.mktemp("resume")
    data = write_tiny_sequence(folder / "tiny")
    assert main(["train", str(data), str(folder / "whole"), *QUICK]) == 0
    cfg = config_of_run(folder / "whole")

    def interrupt(report, trainer):
        if report.iteration == 5:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        endoprior.train(endoprior.load_sequence(data), cfg, folder / "parts", on_step=interrupt)
    return data, folder / "parts", folder / "whole" / "scene.safetensors"


@pytest.fixture
def parts(interrupted, tmp_path) -> Path:
    """A copy of the interrupted run."""
    return Path(shutil.copytree(interrupted[1], tmp_path / "my parts"))


def complaint(capsys) -> str:
    text = capsys.readouterr().err
    assert text.startswith("endoprior: ") and text.count("\n") == 1
    return text


def test_the_run_folder_is_enough(interrupted, parts, capsys):
    assert main(["train", "--resume", str(parts), "--no-networks"]) == 0, capsys.readouterr().err
    assert (parts / "scene.safetensors").read_bytes() == interrupted[2].read_bytes()


def test_the_api_takes_data_and_config_of_the_run(interrupted, parts):
    endoprior.train(out=parts, resume=True)
    assert (parts / "scene.safetensors").read_bytes() == interrupted[2].read_bytes()
    with pytest.raises(ValueError, match="needs a sequence and a config"):
        endoprior.train(out=parts)


@pytest.mark.slow
@pytest.mark.parametrize("options", [["--seed", "3"], QUICK])
def test_both_folders_with_any_options_that_agree(interrupted, parts, options, capsys):
    assert main(["train", str(interrupted[0]), str(parts), "--resume", *options, "--no-networks"]) == 0
    assert (parts / "scene.safetensors").read_bytes() == interrupted[2].read_bytes()


@pytest.mark.parametrize("has_checkpoint", [True, False])
def test_options_that_differ_are_named_all(interrupted, parts, capsys, has_checkpoint):
    if not has_checkpoint:
        (parts / "checkpoint.safetensors").unlink()
    before = (parts / "config.json").read_bytes()
    assert main(["train", str(parts), "--resume", "--seed", "4", "--loss.depth-weight", "9"]) == 2
    assert "seed (3 in the folder, 4 now), loss.depth_weight (1.0 in the folder, 9.0 now)" in complaint(capsys)
    assert main(["train", str(interrupted[0]), str(parts), "--resume", "--preset", "default"]) == 2
    assert "deformation.kind (hexplane in the folder, basis now)" in complaint(capsys)
    assert (parts / "config.json").read_bytes() == before


def test_what_cannot_be_resumed(interrupted, parts, tmp_path, capsys):
    assert main(["train", "--resume", str(tmp_path / "nowhere")]) == 2
    assert "nowhere/config.json: expected a JSON object" in complaint(capsys)
    assert main(["train", str(interrupted[0])]) == 2
    assert "Fix: `endoprior train DATA RUN`" in complaint(capsys)
    facts = json.loads((parts / "config.json").read_text())
    (parts / "config.json").write_text(json.dumps(facts | {"data": facts["data"] | {"path": "/gone"}}))
    assert main(["train", "--resume", str(parts)]) == 2
    assert "Fix: `endoprior train DATA RUN --resume`" in complaint(capsys)
    assert main(["train", str(interrupted[0]), str(parts)]) == 2
    assert "or resume the run in it" in complaint(capsys)


def test_a_run_of_an_earlier_version_has_defaults_for_later_fields(interrupted, parts):
    facts = json.loads((parts / "config.json").read_text())
    del facts["config"]["data"]["stride"]
    (parts / "config.json").write_text(json.dumps(facts))
    (parts / "checkpoint.safetensors").unlink()  # its config is compared with that of config.json
    endoprior.train(out=parts, resume=True)
    assert (parts / "scene.safetensors").read_bytes() == interrupted[2].read_bytes()


def test_a_config_file_overrides_the_preset_and_options_override_it(interrupted, tmp_path):
    file = interrupted[1] / "config.json"
    assert Train.from_words(["a", "b", "--config", str(file)]).config == config_of_run(interrupted[1])
    some = tmp_path / "some.yaml"
    some.write_text("seed: 7\ninit: {budget: 123}\n")
    expected = replace(preset("paper"), seed=7, init=replace(preset("paper").init, budget=123))
    args = Train.from_words(["a", "b", "--preset", "best", "--preset=paper", f"--config={some}"])
    assert (args.preset, args.config) == ("paper", expected)
    words = ["train", str(interrupted[0]), str(tmp_path / "run"), *QUICK, "--config", str(some)]
    assert main(words) == 0
    stored = config_of_run(tmp_path / "run")
    assert (stored.seed, stored.init.budget, stored.deformation.kind) == (3, 200, "hexplane")


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.yaml", "sed: 7", "config.sed: expected one of"),
        ("a.yaml", "init: {budget: many}", "config.init.budget"),
        ("a.yaml", "[1, 2]", "expected named fields of the config, got list"),
        ("a.yaml", "{", "expected YAML"),
        ("a.json", "{", "expected a JSON object"),
        ("a.json", '{"config": 3}', "expected named fields of the config, got int"),
    ],
)
def test_bad_config_files(tmp_path, name, text, says):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        read_config(tmp_path / name, preset())
    assert str(caught.value).startswith(f"{tmp_path / name}: ") and says in str(caught.value)
