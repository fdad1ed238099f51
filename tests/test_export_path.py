"""`--format tum` and `kitti`: the camera path as the benchmarks define it, and back in by `--poses`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from export_scenes import export, moving_scene
from relief import HEIGHT, MATRIX, WIDTH, path, view
from scipy.spatial.transform import Rotation

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data.writer import SequenceMeta, new_sequence
from endoprior.prepare.camera_path.pose_file import read_text_poses

RATE = 12.5
TRUE = path(10, 1.3)  # camera to world, mm


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run whose camera moves along the path."""
    scene, folder = moving_scene(), tmp_path_factory.mktemp("path") / "run"
    cameras = tuple(replace(scene.cameras[0], world_to_camera=np.linalg.inv(pose)) for pose in TRUE)
    replace(scene, cameras=cameras, frames_per_second=RATE).save(folder / "scene.safetensors")
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A sequence folder with images along the path, and other poses."""
    folder = tmp_path_factory.mktemp("path") / "DATA"
    focal = dict(fx=MATRIX[0, 0], fy=MATRIX[1, 1], cx=MATRIX[0, 2], cy=MATRIX[1, 2])
    meta = SequenceMeta(
        WIDTH, HEIGHT, **focal, frames_per_second=RATE, baseline_mm=4.0, depth_scale=0.01, depth_relative=False,
        sources={"depth": "rendered", "lens": "calibration"},
    )  # fmt: skip
    with new_sequence(folder, meta) as writer:
        for pose in TRUE:
            frame = view(pose)
            writer.add(frame.rgb_u8, ~frame.tissue_mask, frame.depth)
    return folder


def stored_poses(folder):
    return np.load(folder / "poses_bounds.npy")[:, :15].reshape(-1, 3, 5)[:, :, :4]


def test_tum_is_time_position_and_quaternion_of_the_camera(run, tmp_path, capsys):
    assert export(run, tmp_path / "a.tum", "tum") == 0
    assert "note: camera to world, OpenCV axes, m, of the frames after rectification" in capsys.readouterr().out
    rows = np.loadtxt(tmp_path / "a.tum")
    assert rows.shape == (10, 8) and rows[:, 0] == pytest.approx(np.arange(10) / RATE, abs=1e-9)
    assert 1000 * rows[:, 1:4] == pytest.approx(TRUE[:, :3, 3], abs=1e-5)
    assert Rotation.from_quat(rows[:, 4:]).as_matrix() == pytest.approx(TRUE[:, :3, :3], abs=1e-7)
    assert (tmp_path / "a.tum").read_text().startswith("# time x y z qx qy qz qw: camera to world, OpenCV axes, m")


def test_kitti_is_the_pose_row_by_row(run, tmp_path):
    assert export(run, tmp_path / "a.kitti", "kitti", "--split", "test") == 0
    assert "#" not in (tmp_path / "a.kitti").read_text()
    rows = np.loadtxt(tmp_path / "a.kitti").reshape(-1, 3, 4)
    assert rows[:, :, :3] == pytest.approx(TRUE[[1, 9], :3, :3], abs=1e-7)
    assert 1000 * rows[:, :, 3] == pytest.approx(TRUE[[1, 9], :3, 3], abs=1e-5)


def test_lengths_of_an_assumed_scale_are_not_called_meters(tmp_path, capsys):
    replace(moving_scene(), lengths_are_relative=True).save(tmp_path / "run/scene.safetensors")
    assert export(tmp_path / "run", tmp_path / "a.tum", "tum") == 0
    assert "1000 units of an assumed scale" in capsys.readouterr().out
    assert "1000 units of an assumed scale" in (tmp_path / "a.tum").read_text().splitlines()[0]


@pytest.mark.parametrize("kind", ["tum", "kitti"])
def test_the_path_comes_back_in(run, data, tmp_path, capsys, kind):
    assert main(["export", str(run), str(tmp_path / f"a.{kind}")]) == 0
    assert main(["poses", str(data), "--poses", str(tmp_path / f"a.{kind}")]) == 0
    assert stored_poses(data) == pytest.approx(TRUE[:, :3], abs=1e-5)
    said = f"a.{kind}: rows are matched in order, one for each image; its unit is taken as 1000 mm"
    assert said in capsys.readouterr().out.replace("\n", " ")


def test_prepare_takes_the_path_of_a_part_of_a_video(run, data, tmp_path, capsys):
    """Its times count from the first frame that is used, not from the start of the video."""
    assert main(["export", str(run), str(tmp_path / "a.tum"), "--times", *(f"{i / 10}" for i in range(6))]) == 0
    options = ["--layout", "mono", "--masks", "none", "--border", "keep", "--depth", str(data / "depth")]
    options += ["--depth-unit-mm", "0.01", "--calibration", str(data / "sequence.json"), "--start", "0.16"]
    options += ["--end", "0.64", "--folder-rate", str(RATE), "--poses", str(tmp_path / "a.tum")]
    assert main(["prepare", str(data / "images"), str(tmp_path / "out"), *options]) == 0
    assert "rows are matched by time" in capsys.readouterr().out.replace("\n", " ")
    assert stored_poses(tmp_path / "out") == pytest.approx(TRUE[:6, :3], abs=1e-5)


TIMES = np.arange(20) / 25  # of the images of a video
MATCHED = {
    "since the start of the video": (TIMES[2:15], [3, 5, 7], [1, 3, 5], "by time"),
    "clock times since the first image": (1.6e9 + TIMES[:15], [3, 5, 7], [3, 5, 7], "by time"),
    "clock times of the frames": (1.6e9 + TIMES[3:8:2], [3, 5, 7], [0, 1, 2], "by time"),
    "times of every second image": (TIMES[::2], [2, 4, 8], [1, 2, 4], "by time"),
    "another rate, one for each image": (
        np.arange(20) / 30 + 0.5,
        [3, 5, 7],
        [3, 5, 7],
        "in order, one for each image",
    ),
    "another rate, one for each frame": (np.arange(3) / 7 + 0.5, [3, 5, 19], [0, 1, 2], "in order, one for each frame"),
    "numbers": (np.arange(1, 21), [3, 5, 7], [3, 5, 7], "by the numbers of the images"),
}


@pytest.mark.parametrize("case", MATCHED)
def test_rows_are_matched_to_frames(tmp_path, case):
    times, images, rows, rule = MATCHED[case]
    lines = [f"{time!r} {row / 1000} 0 0 0 0 0 1" for row, time in enumerate(times.tolist())]
    (tmp_path / "a.tum").write_text("\n".join(lines))
    poses, said = read_text_poses(tmp_path / "a.tum", len(images), images, TIMES.tolist())
    assert 1000 * poses[:, 0, 3] == pytest.approx(rows) and said == rule


BAD = {
    "other times": ("".join(f"{k / 3 + 0.1} 0 0 0 0 0 0 1\n" for k in range(9)), "9 rows of other times"),
    "mirrored": (
        "-1 0 0 0 0 1 0 0 0 0 1 0\n" * 2,
        "rotations in the left 3x3 of each row, got another matrix in row 0",
    ),
    "not finite": ("nan 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "finite numbers, got NaN or infinity"),
    "mm": ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 30 0 1 0 0 0 0 1 0", "positions in m, within 2 m"),
    "too few": ("1 0 0 0 0 1 0 0 0 0 1 0\n", "1 rows, none for image 3"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_paths_are_rejected(tmp_path, case):
    text, words = BAD[case]
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(InputError) as caught:
        read_text_poses(tmp_path / "a.txt", 2, [0, 3], TIMES.tolist())
    assert str(caught.value).startswith(str(tmp_path / "a.txt")) and words in str(caught.value)


def test_a_unit_may_be_given(run, data, tmp_path):
    assert export(run, tmp_path / "a.tum", "tum") == 0
    rows = np.loadtxt(tmp_path / "a.tum")
    rows[:, 1:4] *= 100  # cm
    np.savetxt(tmp_path / "cm.tum", rows)
    assert main(["poses", str(data), "--poses", str(tmp_path / "cm.tum"), "--poses-unit-mm", "10"]) == 0
    assert stored_poses(data) == pytest.approx(TRUE[:, :3], abs=1e-5)
    rows[:, 1:4] *= 10  # mm
    np.savetxt(tmp_path / "mm.tum", rows)
    assert main(["poses", str(data), "--poses", str(tmp_path / "mm.tum"), "--poses-unit-mm", "1"]) == 0
    assert stored_poses(data) == pytest.approx(TRUE[:, :3], abs=1e-5)
