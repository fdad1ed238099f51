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
from endoprior.runs.folder import config_of_run, read_config, sequence_of_run
from endoprior.runs.train import start_run

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
    assert f"Fix: `endoprior train {interrupted[0]} RUN`" in complaint(capsys)
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


def extended(run: Path, to: Path, total: int, stop_at: int = 0, seconds: float = 60) -> Path:
    """A copy of the run, extended to so many iterations; killed after fine iteration `stop_at` if it is given."""
    out = Path(shutil.copytree(run, to))
    if not stop_at:
        assert main(["train", "--resume", str(out), "--iterations", str(total), "--no-networks"]) == 0
        return out

    def kill(report, trainer):
        if report.iteration == stop_at:
            raise RuntimeError("killed")

    cfg = config_of_run(out).extended(total)
    sequence = endoprior.load_sequence(sequence_of_run(out), cfg.data)
    with pytest.raises(RuntimeError, match="killed"):
        run_on = start_run(sequence, cfg, out, resume=True, extends=True, say=lambda text: None)
        run_on.complete(kill, checkpoint_seconds=seconds)
    return out


@pytest.mark.parametrize("seconds", [0, 60])  # 60: a kill leaves the checkpoint from before the extension
def test_a_finished_run_is_extended_and_a_killed_extension_resumes(interrupted, tmp_path, seconds):
    whole = interrupted[2].parent
    before = config_of_run(whole)
    assert (whole / "metrics.json").is_file()
    once = extended(whole, tmp_path / "once", 20)
    cfg = config_of_run(once)
    density = replace(before.density, stop_iteration=12)
    assert cfg == replace(before, schedule=replace(before.schedule, fine_iterations=18), density=density)
    logged = [json.loads(line)["iteration"] for line in (once / "log.jsonl").read_text().splitlines()]
    assert logged[-1] == 10 and (once / "metrics.json").is_file()
    scene = (once / "scene.safetensors").read_bytes()
    assert scene != (whole / "scene.safetensors").read_bytes()

    killed = extended(whole, tmp_path / "killed", 20, stop_at=16, seconds=seconds)
    assert config_of_run(killed) == cfg
    assert not [name for name in ("scene.safetensors", "metrics.json") if (killed / name).exists()]
    assert main(["train", "--resume", str(killed), "--no-networks"]) == 0
    assert (killed / "scene.safetensors").read_bytes() == scene


def test_an_extension_is_the_training_of_that_config_from_the_checkpoint_on(interrupted, parts, tmp_path):
    """Growth does not reach these iterations, so that the run of the extended config has the same first ones."""
    once = extended(interrupted[2].parent, tmp_path / "once", 20)
    assert main(["train", "--resume", str(parts), "--iterations", "20", "--no-networks"]) == 0
    cfg = config_of_run(once)
    endoprior.train(endoprior.load_sequence(interrupted[0]), cfg, tmp_path / "new")
    for run in (parts, tmp_path / "new"):
        assert (run / "scene.safetensors").read_bytes() == (once / "scene.safetensors").read_bytes()


def test_a_stopped_run_can_be_made_shorter(parts):
    assert main(["train", "--resume", str(parts), "--iterations", "10", "--no-networks"]) == 0
    assert config_of_run(parts).schedule.total == 10
    assert (parts / "scene.safetensors").is_file()


@pytest.mark.parametrize("total", ["14", "13", "3", "2", "1"])
def test_an_extension_that_is_none(interrupted, tmp_path, total, capsys):
    run = Path(shutil.copytree(interrupted[2].parent, tmp_path / "run"))
    before = {file.name: file.read_bytes() for file in run.iterdir()}
    capsys.readouterr()
    assert main(["train", "--resume", str(run), "--iterations", total]) == 2
    says = "of the coarse stage" if int(total) <= 2 else f"more than the 14 of 14 iterations that {run} has done"
    assert f"--iterations: expected {'more than the 2 ' if int(total) <= 2 else ''}{says}" in (
        text := complaint(capsys)
    )
    assert f"got {total}. Fix: Choose more." in text
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before


@pytest.mark.slow
def test_an_extension_changes_the_length_only(interrupted, parts, capsys):
    before = (parts / "config.json").read_bytes()
    assert main(["train", "--resume", str(parts), "--iterations", "5"]) == 2
    assert f"more than the 7 of 14 iterations that {parts} has done, got 5" in complaint(capsys)
    for options, says in (
        (["--seed", "4"], "seed (3 in the folder, 4 now)"),
        (["--density.stop-iteration", "7"], "density.stop_iteration (12 in the folder, 7 now)"),
        (["--schedule.fine-iterations", "15"], "schedule.fine_iterations (12 in the folder, 15 now)"),
        (["--preset", "paper"], "schedule.fine_iterations (12 in the folder, "),
    ):
        assert main(["train", str(parts), "--resume", "--iterations", "20", *options]) == 2
        assert says in complaint(capsys)
    assert main(["train", str(interrupted[0]), str(parts), "--resume", "--schedule.fine-iterations", "20"]) == 2
    assert "schedule.fine_iterations (12 in the folder, 20 now)" in complaint(capsys)
    assert (parts / "config.json").read_bytes() == before
