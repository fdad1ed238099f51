"""A training says what `check` calls an error, once, and blames white images on their brightness."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sequence_edits import change_poses, describe, edit
from tiny_training import tiny_config

from endoprior.check import find, measure
from endoprior.check.findings import find_errors
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.runs.train import start_run

FRAMES = 16


def phantom(folder: Path, **changes: object) -> Path:
    write_phantom(folder, PhantomConfig(frames=FRAMES, width=160, height=128, **changes))
    shutil.rmtree(folder / "truth")
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return phantom(tmp_path_factory.mktemp("errors") / "data", stereo=True, camera="inspect")


@pytest.fixture
def data(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "data"))


def swap_eyes(data: Path) -> None:
    (data / "images").rename(data / "left")
    (data / "right").rename(data / "images")
    (data / "left").rename(data / "right")


def cut(data: Path) -> None:
    other = phantom(data.with_name("other"), seed=7)
    for file in sorted((data / "images").iterdir())[FRAMES // 2 :]:
        shutil.copy(other / "images" / file.name, file)


ERRORS: dict[str, Callable[[Path], object]] = {
    "depth-unit": lambda data: describe(data, depth_scale=10.0),  # tissue at 77 m
    "depth-centimetres": lambda data: describe(data, depth_scale=0.001),
    "mask-polarity": lambda data: edit(data / "masks", lambda mask, _: 255 - mask),
    "scene-cut": cut,
    "swapped-eyes": swap_eyes,
}


@pytest.mark.parametrize("code", ERRORS)
def test_training_finds_the_errors_of_check(data, code):
    ERRORS[code](data)
    sequence = load_sequence(data)
    found = find_errors(sequence)
    assert code in [finding.code for finding in found]
    assert found == [finding for finding in find(measure(sequence)) if finding.code in {each.code for each in found}]


def test_training_finds_poses_of_another_convention(tmp_path):
    data = phantom(tmp_path / "data", camera="inspect")
    assert find_errors(load_sequence(data)) == []
    change_poses(data, lambda poses: poses @ np.diag([*np.tile([1, -1, -1, 1, 1], 3), 1, 1]))
    codes = [finding.code for finding in find_errors(load_sequence(data))]
    assert codes == ["poses-convention"]
    assert codes == [each.code for each in find(measure(load_sequence(data))) if each.severity == "error"]


def test_a_training_of_several_windows_says_an_error_once(data, tmp_path):
    describe(data, depth_scale=10.0)
    cfg, said = tiny_config("basis", 1, 1).replace({"windows.longest": 10}), list[str]()
    run = start_run(load_sequence(data, cfg.data), cfg, tmp_path / "run", say=said.append)
    run.complete()
    (line,) = (line for line in said if line.startswith("check: error: depth-unit: the median is 7"))
    assert 'Fix: set "depth_scale": MM_PER_UNIT in ' in line
    # A run that is resumed has said it before.
    said.clear()
    start_run(load_sequence(data, cfg.data), cfg, tmp_path / "run", resume=True, say=said.append)
    assert not [line for line in said if "error" in line]


def test_white_images_are_an_error_about_brightness(data, tmp_path):
    edit(data / "images", lambda image, _: np.full_like(image, 252))
    with pytest.raises(InputError, match=r"expected a level below 250 .* got 0.0%: the images are white\. Fix: Exp"):
        start_run(load_sequence(data), tiny_config("basis"), tmp_path / "run", say=str)
    errors = [finding for finding in find(measure(load_sequence(data))) if finding.severity == "error"]
    assert [finding.code for finding in errors] == ["overexposed"]
