"""Conventions of camera poses: converted in closed form, told by reprojection, corrected by the printed command."""

import shlex

import numpy as np
import pytest
from relief import HEIGHT, MATRIX, WIDTH, path, view

from endoprior.check import find, measure
from endoprior.cli import main
from endoprior.core.geometry import CONVENTIONS, to_ours
from endoprior.data import load_sequence
from endoprior.data.writer import SequenceMeta, new_sequence
from endoprior.footage.pose_fit import measure_poses

COUNT = 16
TRUE = path(COUNT, 1.3)
FLIP = np.diag([1.0, -1, -1, 1])
COLUMNS = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""Right, down, forward to down, right, back."""
FILES = {
    "opencv": TRUE,
    "opengl": TRUE @ FLIP,
    "llff": TRUE @ COLUMNS,
    "world-to-camera": np.linalg.inv(TRUE),
    "world-to-camera-opengl": np.linalg.inv(TRUE @ FLIP),
}


def in_meters(poses, unit=1000.0):
    out = poses.copy()
    out[:, :3, 3] /= unit
    return out


@pytest.fixture(scope="module")
def seen():
    """Frames along the true path."""
    return [view(pose) for pose in TRUE]


@pytest.fixture(scope="module")
def data(tmp_path_factory, seen):
    """A folder with the true poses."""
    folder = tmp_path_factory.mktemp("conventions") / "DATA"
    focal = dict(fx=MATRIX[0, 0], fy=MATRIX[1, 1], cx=MATRIX[0, 2], cy=MATRIX[1, 2])
    meta = SequenceMeta(
        WIDTH, HEIGHT, **focal, frames_per_second=25, baseline_mm=4.0, depth_scale=0.01, depth_relative=False,
        sources={"depth": "rendered", "lens": "calibration"},
    )  # fmt: skip
    with new_sequence(folder, meta) as writer:
        for frame in seen:
            writer.add(frame.rgb_u8, ~frame.tissue_mask, frame.depth)
    return folder


def fit(seen, poses, **options):
    def read(index):
        return seen[index].rgb_u8, seen[index].tissue_mask, seen[index].depth

    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    return measure_poses(read, MATRIX - half, poses, **options)


def test_every_convention_is_converted():
    assert set(FILES) == set(CONVENTIONS)
    for name, poses in FILES.items():
        before = poses.copy()
        assert np.allclose(to_ours(poses, name), TRUE) and np.array_equal(poses, before)
        assert np.allclose(to_ours(in_meters(poses), name, 1000.0), TRUE)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_the_images_tell_the_convention_and_the_unit(seen, name, unit):
    found = fit(seen, in_meters(FILES[name], unit))
    assert (found.best, found.unit, found.as_good) == (name, unit, ()) and found.best_px < 1
    right = name == "opencv" and unit == 1
    assert found.another_fits != right and not found.none_fits
    assert right or found.given_px > 5 * found.best_px


def test_a_unit_that_is_no_plain_one(seen):
    found = fit(seen, in_meters(FILES["opencv"], 41.0))
    assert found.best == "opencv" and found.unit == pytest.approx(41, rel=0.1) and found.another_fits


def test_shuffled_poses_fit_in_no_convention(seen):
    found = fit(seen, TRUE[np.random.default_rng(0).permutation(COUNT)])
    assert found.none_fits and not found.another_fits


def test_a_given_convention_that_is_right_is_not_questioned(seen):
    for name, poses in FILES.items():
        found = fit(seen, poses, given=name)
        assert found.best == name and not found.another_fits and found.given_px < 1


def test_relative_depth_tells_the_convention_and_no_unit(seen):
    assert not fit(seen, in_meters(TRUE), relative=True).another_fits
    found = fit(seen, in_meters(FILES["opengl"]), relative=True)
    assert found.another_fits and (found.best, found.unit) == ("opengl", 1.0)


def test_poses_of_a_camera_that_rectification_turned(seen):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    source = TRUE.copy()
    source[:, :3, :3] = TRUE[:, :3, :3] @ turn  # frame axes = turn @ source axes
    assert fit(seen, source, turn=turn).given_px < 1 < fit(seen, source).given_px


def test_a_static_camera_and_blank_images_say_nothing(seen):
    assert fit(seen, np.tile(TRUE[3], (COUNT, 1, 1))) is None
    blank = [type(frame)(np.zeros_like(frame.rgb_u8), frame.tissue_mask, frame.depth) for frame in seen]
    assert fit(blank, TRUE) is None


@pytest.mark.parametrize(
    ("name", "unit", "words"),
    [
        ("opengl", 1.0, ["--poses-convention", "opengl"]),
        pytest.param(
            *("world-to-camera", 1000.0, ["--poses-convention", "world-to-camera", "--poses-unit-mm", "1000"]),
            marks=pytest.mark.slow,
        ),
        pytest.param("opencv", 1000.0, ["--poses-unit-mm", "1000"], marks=pytest.mark.slow),
    ],
)
def test_poses_of_another_convention_are_noticed_by_all_commands_and_corrected(
    data, tmp_path, capsys, name, unit, words
):
    np.save(tmp_path / "poses.npy", in_meters(FILES[name], unit))
    out = tmp_path / "OUT"
    options = ["--layout", "mono", "--masks", "none", "--border", "keep", "--depth", data / "depth"]
    options += ["--depth-unit-mm", "0.01", "--calibration", data / "sequence.json", "--poses", tmp_path / "poses.npy"]
    assert main(["prepare", *map(str, [data / "images", out, *options])]) == 0
    assert " ".join(words) in capsys.readouterr().out
    (finding,) = (found for found in find(measure(load_sequence(out))) if found.code == "poses-convention")
    assert finding.severity == "error" and "without camera motion" in finding.what
    program, *command = shlex.split(finding.fix.split("`")[1])
    assert program == "endoprior" and command[-len(words) :] == words
    assert main(command) == 0
    stored = np.load(out / "poses_bounds.npy")[:, :15].reshape(-1, 3, 5)[:, :, :4]
    assert np.allclose(stored, TRUE[:, :3], atol=1e-6) and (out / "poses_bounds_before.npy").exists()
    assert "poses-convention" not in {found.code for found in find(measure(load_sequence(out)))}
    again = [*options, *words]
    assert main(["prepare", *map(str, [data / "images", tmp_path / "again", *again])]) == 0
    assert "explain the images" not in capsys.readouterr().out
    stored = np.load(tmp_path / "again" / "poses_bounds.npy")[:, :15].reshape(-1, 3, 5)[:, :, :4]
    assert np.allclose(stored, TRUE[:, :3], atol=1e-6)


def test_a_convention_without_a_file_is_an_error(data, tmp_path, capsys):
    assert main(["poses", str(data), "--poses", "still", "--poses-convention", "opengl"]) == 2
    assert "--poses-convention: expected a file with --poses, got --poses still" in capsys.readouterr().err
    assert main(["poses", str(data), "--poses-unit-mm", "0"]) == 2
