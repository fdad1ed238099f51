"""`endoprior sample`: the files, what the video shows against its calibration, and depth measured in it."""

from __future__ import annotations

import av
import cv2
import numpy as np
import pytest

from endoprior.cli import main
from endoprior.cli.phantom import write_sample
from endoprior.data import load_sequence
from endoprior.phantom.camera import CameraPose
from endoprior.phantom.raster import FAR, rasterize
from endoprior.phantom.sample import RECORDED, SampleConfig, phantom_of, rays_of, sample_frames
from endoprior.phantom.scene import build_scene
from endoprior.phantom.views import RenderedView
from endoprior.prepare.calibration_files import read_calibration
from endoprior.prepare.frame_geometry import rectify

TINY = SampleConfig(seed=3, frames=3, width=96, height=80)
BEADS = np.array([[-14.0, -9, 70], [12, -11, 80], [0, 3, 75], [-13, 12, 90], [15, 8, 72], [3, -3, 110]])
"""(N, 3) mm, in the axes of the left camera; clear of label and clock."""


def decoded(path):
    with av.open(str(path)) as video:
        assert video.streams.video[0].codec_context.name == "h264"
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("sample") / "a b"
    write_sample(out, TINY)
    return out


def test_files(folder):
    assert sorted(path.name for path in folder.iterdir()) == ["README.txt", "calibration.yaml", "sample.mp4"]
    frames = decoded(folder / "sample.mp4")
    assert [frame.shape for frame in frames] == [(80, 192, 3)] * 3
    left, right = frames[1][:, :96], frames[1][:, 96:]
    for image in (left, right):  # tissue is red, and the stop leaves the corners dark
        assert image[30:50, 30:66, 0].mean() > image[30:50, 30:66, 1].mean() + 30 and image[-6:, -6:].max() < 40
    assert np.abs(left.astype(int) - right).mean() > 5 and np.abs(frames[2].astype(int) - frames[0]).mean() > 1
    words = (folder / "README.txt").read_text()
    assert f"endoprior run '{folder}/sample.mp4' RUN --calibration '{folder}/calibration.yaml'\n" in words.replace(
        "\\", "/"
    )


def test_the_same_seed_gives_the_same_bytes(folder, tmp_path):
    for name, seed in (("same", TINY.seed), ("other", TINY.seed + 1)):
        write_sample(tmp_path / name, SampleConfig(seed, TINY.frames, TINY.width, TINY.height))
        for file in ("sample.mp4", "calibration.yaml"):
            equal = (tmp_path / name / file).read_bytes() == (folder / file).read_bytes()
            assert equal == (name == "same" or file == "calibration.yaml")


def test_points_are_where_the_calibration_says(tmp_path, monkeypatch):
    """White beads at known places, in place of the scene: through lens and codec, both cameras show them there."""

    def beads(scene, now, eye):
        cfg = scene.cfg
        y, x = np.mgrid[: cfg.height, : cfg.width] + 0.5
        image = np.full((cfg.height, cfg.width, 3), 0.02, np.float32)
        for point in eye.to_camera(BEADS):
            u, v = cfg.focal * point[:2] / point[2] + cfg.center
            image += np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8)[..., None].astype(np.float32) * 0.1
        return RenderedView(image, image, image[..., 0] * 0, image[..., 0] * 0)

    monkeypatch.setattr("endoprior.phantom.sample.render_view", beads)
    cfg = SampleConfig(frames=2, width=320, height=256)
    write_sample(tmp_path / "s", cfg)
    frame = decoded(tmp_path / "s" / "sample.mp4")[1].astype(np.float64).mean(-1)
    calibration = read_calibration(tmp_path / "s" / "calibration.yaml")
    assert calibration.size == (320, 256) and calibration.right is not None
    assert np.linalg.norm(calibration.translation_mm) == pytest.approx(4.2, abs=0.01)
    poses = (np.eye(3), np.zeros(3)), (calibration.rotation, calibration.translation_mm)
    for image, camera, (turn, shift) in zip(np.split(frame, 2, 1), calibration.cameras, poses, strict=True):
        # Pixel centers are at 0.5 in `calibration`, and at 0 in OpenCV.
        seen = cv2.projectPoints(BEADS, turn, shift, camera.matrix, camera.distortion)[0][:, 0] - 0.5
        for x, y in seen:
            j, i = round(x), round(y)
            part = image[i - 5 : i + 6, j - 5 : j + 6]
            light = (part / 255) ** 2.2
            light -= np.median(np.concatenate([light[0], light[-1], light[:, 0], light[:, -1]]))
            down, across = np.mgrid[i - 5 : i + 6, j - 5 : j + 6]
            found = np.array([(light * across).sum(), (light * down).sum()]) / light.sum()
            assert np.abs(found - (x, y)).max() < 0.2  # the codec moves 0.1; a center taken elsewhere is 0.5 off


@pytest.mark.parametrize("right", [0, 1])
def test_rays_undo_the_lens(right):
    """Points on the rays project to the pixels that the rays are of, to a thousandth of a pixel."""
    cfg = SampleConfig()
    lens, rays = cfg.lenses[right], rays_of(cfg, right)
    points = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1).reshape(-1, 3)
    turn = cfg.rotation if right else np.eye(3)
    pixels = cv2.projectPoints(points, turn, np.zeros(3), lens.matrix, lens.distortion)[0].reshape(384, 480, 2)
    assert np.abs(pixels - np.stack(np.meshgrid(np.arange(480), np.arange(384)), -1)).max() < 1e-3


def test_a_folder_in_use_and_a_bad_seed_are_errors(tmp_path, capsys):
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "kept").touch()
    assert main(["sample", str(tmp_path / "used")]) == 2
    assert "a new or empty folder" in capsys.readouterr().err
    assert main(["sample", str(tmp_path / "new"), "--seed", "-1"]) == 2
    assert "seed: expected a value in [0, " in capsys.readouterr().err
    assert [path.name for path in tmp_path.rglob("*")] == ["used", "kept"]


def test_the_clip_of_the_default_seed_comes_with_the_program(tmp_path):
    assert main(["sample", str(tmp_path / "s")]) == 0
    assert (tmp_path / "s/sample.mp4").read_bytes() == RECORDED.read_bytes() and RECORDED.stat().st_size < 700_000
    assert len(decoded(RECORDED)) == SampleConfig().frames


@pytest.mark.slow
def test_the_stored_clip_is_what_would_be_drawn():
    """Up to the codec, which smooths the noise. Else `write_sample` draws a new one for `RECORDED`."""
    drawn = next(iter(sample_frames(SampleConfig()))).astype(np.float64)
    assert 10 * np.log10(255**2 / ((decoded(RECORDED)[0] - drawn) ** 2).mean()) > 28


@pytest.mark.slow
def test_prepared_it_has_the_true_depth(tmp_path, capsys):
    """The whole clip by the commands: border and label are found, and depth is that of the phantom."""
    out, data, cfg = tmp_path / "S", tmp_path / "data", SampleConfig()
    assert main(["sample", str(out)]) == 0
    assert "--preview`" in capsys.readouterr().out.splitlines()[-1]
    calibration = out / "calibration.yaml"
    assert main(["prepare", str(out / "sample.mp4"), str(data), "--calibration", str(calibration)]) == 0
    said = capsys.readouterr().out
    assert "round border: center (240, 192), radius 2" in said and "burnt-in text: text in 60 frames at " in said
    sequence, scene = load_sequence(data), build_scene(phantom_of(cfg, [rays_of(cfg, right) for right in (0, 1)]))
    turn = rectify(read_calibration(calibration), (cfg.width, cfg.height), "c", stereo=True)[1]
    assert len(sequence) == cfg.frames
    for index in (0, 25, 59):
        frame, vertices = sequence.frame(index), scene.vertices(index / (cfg.frames - 1))
        camera = frame.camera
        assert abs(camera.fx / camera.fy - 1) < 1e-3
        seen = CameraPose(np.zeros(3), turn.T).to_camera(vertices)
        z = rasterize(seen, camera.fx, (camera.cx, camera.cy), camera.width, camera.height)[..., 2]
        known = frame.tissue_mask & frame.depth_valid & (z < FAR)
        error = np.abs(frame.depth - z)[known]
        # 1 mm at this distance is a third of a pixel of disparity.
        assert known.mean() > 0.55 and np.median(error) < 0.5 and (error > 3).mean() < 0.06
        assert abs(np.median((frame.depth - z)[known])) < 0.2
