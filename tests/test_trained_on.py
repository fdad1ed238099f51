"""What a scene says of the sequence it was trained on, and what `evaluate` makes of it."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest
from sequence_edits import describe, edit
from state_files import StateFile
from tiny_training import tiny_config

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig, WindowConfig
from endoprior.data import load_sequence
from endoprior.evaluation.scoring import OTHER_IMAGES, SAME_FILES, SAME_IMAGES, evaluate
from endoprior.model.scene_file import load_scene
from endoprior.runs.train import train


@pytest.fixture
def run(tiny_sequence, tmp_path) -> Path:
    """The run folder of a short training on `tiny_sequence`."""
    train(load_sequence(tiny_sequence), tiny_config("basis", 1, 2), tmp_path / "run")
    return tmp_path / "run"


def test_the_first_file_that_is_missing_is_named(tiny_sequence):
    sequence = load_sequence(tiny_sequence)
    first = min(sequence.files)
    for file in sequence.files:
        file.unlink()
    with pytest.raises(InputError) as error:
        sequence.fingerprints()
    assert str(error.value).startswith(f"{first}: ")


def brighter(folder: Path) -> None:
    edit(folder, lambda image, _position: image // 2 + 60)


def moved(folder: Path) -> None:
    edit(folder, lambda image, _position: image[:, ::-1])


def scored(run: Path, folder: Path) -> str | None:
    """`trained_on` of the protocol."""
    found = evaluate(load_scene(run), load_sequence(folder), networks=False, speed=False)
    return found.protocol.get("trained_on")


def test_a_scene_knows_the_files_it_was_trained_on(tiny_sequence, run):
    sequence = load_sequence(tiny_sequence)
    stored = json.loads((run / "config.json").read_text())
    for scene in (load_scene(run), train(sequence, tiny_config("basis", 1, 2))):
        assert scene.trained_on == sequence.fingerprints() and scene.trained_on.data == stored["data"]["fingerprint"]
    assert load_scene(run).to("cpu", backend="reference").trained_on == sequence.fingerprints()


def test_other_images_are_scored_with_a_warning(tiny_sequence, run, caplog):
    assert scored(run, tiny_sequence) == SAME_FILES and not caplog.records
    brighter(tiny_sequence / "images")
    assert scored(run, tiny_sequence) == OTHER_IMAGES
    (warning,) = caplog.records
    text = warning.getMessage()
    assert warning.levelno == logging.WARNING and "\n" not in text and "--data FOLDER" in text
    known, found = load_scene(run).trained_on.images[:8], load_sequence(tiny_sequence).fingerprints().images[:8]
    assert text.startswith(f"warning: {tiny_sequence}: expected the images that") and known in text and found in text


@pytest.mark.parametrize(
    "change",
    [
        lambda folder: moved(folder / "masks"),
        lambda folder: moved(folder / "depth"),
        lambda folder: describe(folder, frames_per_second=7),
    ],
    ids=["masks", "depth", "json"],
)
def test_other_masks_or_depth_of_the_same_images_are_no_other_video(tiny_sequence, run, caplog, capsys, change):
    change(tiny_sequence)
    assert scored(run, tiny_sequence) == SAME_IMAGES and not caplog.records
    assert main(["eval", str(run), "--no-networks"]) == 0
    assert f"note: {tiny_sequence}: masks, depth, poses or sequence.json changed since the" in capsys.readouterr().out


def test_a_scene_of_an_earlier_version_is_compared_with_nothing(tiny_sequence, run, caplog):
    file = StateFile.read(run / "scene.safetensors")
    del file.about["trained_on"]
    file.write(run / "scene.safetensors")
    brighter(tiny_sequence / "images")
    assert load_scene(run).trained_on is None and scored(run, tiny_sequence) is None and not caplog.records


def test_a_damaged_fingerprint_is_named(run):
    file = StateFile.read(run / "scene.safetensors")
    file.about["trained_on"] = {"data": 3, "images": ""}
    file.write(run / "scene.safetensors")
    with pytest.raises(InputError, match=r"scene\.safetensors: about\.trained_on\.data: expected str, got 3"):
        load_scene(run)


def test_windows_know_their_own_images(make_tiny_sequence, tmp_path, caplog):
    data = make_tiny_sequence("long", num_frames=20)
    cfg = replace(tiny_config("basis", 1, 2), windows=WindowConfig(longest=12))
    whole, sequence = train(load_sequence(data), cfg, tmp_path / "run"), load_sequence(data)
    assert load_scene(tmp_path / "run").trained_on == whole.trained_on == sequence.fingerprints()
    second = load_scene(tmp_path / "run/windows/001")
    part = load_sequence(data, second.config.data)
    assert second.trained_on == part.fingerprints() and second.trained_on.images != whole.trained_on.images
    assert second.trained_on.data == whole.trained_on.data, "all windows are of one sequence"
    for scene, scored_on, said in ((whole, sequence, SAME_FILES), (second, part, SAME_FILES)):
        found = evaluate(scene, scored_on, networks=False, speed=False)
        assert found.protocol["trained_on"] == said and not caplog.records
    other_half = load_sequence(data, DataConfig(window="0-13"))
    assert len(other_half) == len(second.cameras)
    assert evaluate(second, other_half, networks=False, speed=False).protocol["trained_on"] == OTHER_IMAGES
