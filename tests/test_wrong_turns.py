"""What a newcomer types wrongly leads to the command that was meant: order and names of paths, steps left out."""

from __future__ import annotations

import shutil

import pytest
from video_files import smooth, write_video

from endoprior.cli import main


@pytest.fixture
def here(tmp_path, monkeypatch, tiny_sequence):
    """The current folder, with `mine`: a folder of images and masks, and nothing else."""
    folder = tmp_path / "here"
    for part in ("images", "masks"):
        shutil.copytree(tiny_sequence / part, folder / "mine" / part)
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("prepare mine", "endoprior prepare mine OUT"),
        ("run mine --preview", "endoprior run mine OUT"),
        ("run --preview mine", "endoprior run VIDEO OUT"),
        ("scan", "endoprior scan VIDEO"),
        ("train mine", "endoprior prepare mine mine_data"),
        ("train mine RUN", "endoprior prepare mine mine_data"),
        ("run OUT mine", "endoprior run mine OUT"),
        ("prepare OUT mine", "endoprior prepare mine OUT"),
        ("run mine mine", "endoprior run mine mine_out"),
        ("run mine ./mine/", "endoprior run mine mine_out"),
        ("prepare mine mine", "endoprior prepare mine mine_data"),
        ("prepare MINE OUT", "mine"),
        ("run mein OUT", "mine"),
        ("check mime", "mine"),
        ("view mnie", "mine"),
    ],
)
def test_the_command_that_was_meant_is_named(typed, meant, here, capsys):
    assert main(typed.split()) == 2
    error = capsys.readouterr().err
    assert f"`{meant}`" in error.partition("Fix: ")[2] and error.count("\n") == 1
    assert [entry.name for entry in here.iterdir()] == ["mine"]


def test_the_sequence_comes_before_the_run(here, tiny_sequence, capsys):
    shutil.copytree(tiny_sequence, here / "data")
    assert main(["train", "RUN", "data"]) == 2
    assert "Fix: The input comes first: `endoprior train data RUN`." in capsys.readouterr().err
    assert main(["train", "data"]) == 2
    assert "Fix: `endoprior train data RUN`." in capsys.readouterr().err


def test_results_are_not_taken_for_the_input_of_a_mistyped_video(here, capsys):
    """A stopped run is typed again, with a slip: its folder holds images, but no frames."""
    run = here / "OUT" / "run"
    run.mkdir(parents=True)
    for name in ("config.json", "log.jsonl"):
        (run / name).write_text("{}")
    for name in ("check.png", "report.png"):
        shutil.copy(next((here / "mine" / "images").iterdir()), here / "OUT" / name)
    assert main(["run", "mien", "OUT"]) == 2
    assert capsys.readouterr().err.endswith("Fix: Correct the path. Did you mean `mine`?\n")


@pytest.mark.parametrize("name", ["calibration.yaml", "calibration.json"])
def test_the_calibration_beside_the_only_video_of_a_folder_is_named(name, here, capsys):
    (here / "S").mkdir()
    write_video(here / "S" / "clip.mp4", smooth(4))
    (here / "S" / name).write_text("{}")
    assert main(["run", "S", "OUT"]) == 2
    assert f"`endoprior run S/clip.mp4 S/clip_out --calibration S/{name}`" in capsys.readouterr().err
