"""Scoring with truth: carried points, tracks, what is behind the tool; the report."""

import json
from dataclasses import replace
from importlib.util import find_spec
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from endoprior.cli import main
from endoprior.data import load_sequence
from endoprior.data.truth import Tracks
from endoprior.evaluation.context import Evaluation
from endoprior.evaluation.networks import WeightsMissing
from endoprior.evaluation.scorers.tracks import by_scene, parts_of, track_end_error_mm, track_scores, true_tracks
from endoprior.evaluation.scoring import evaluate
from endoprior.model.carry import carry_points
from endoprior.model.presets import preset
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.runs.train import train
from endoprior.training.gaussian_trainer import GaussianTrainer


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    """A small phantom."""
    out = tmp_path_factory.mktemp("evaluate") / "phantom"
    write_phantom(out, PhantomConfig(frames=10, width=96, height=80))
    return load_sequence(out)


def still_scene(sequence, budget=400):
    """An untrained scene: Gaussians where they start, that do not move."""
    cfg = preset("default")
    cfg = replace(cfg, init=replace(cfg.init, budget=budget, motion="rest"))
    trainer = GaussianTrainer(sequence, cfg)
    trainer.start()
    return trainer.scene()


@pytest.mark.skipif(find_spec("lpips") is None, reason="network scores need the packages torchvision and lpips")
@pytest.mark.parametrize("asked", [False, True])
def test_weights_are_downloaded_only_if_asked(phantom, monkeypatch, asked):
    sought = {}

    def none(files, _weights_dir=None, *, download=True):
        sought[files.network] = download
        raise WeightsMissing("none")

    for scorer in ("lpips", "motion"):
        monkeypatch.setattr(f"endoprior.evaluation.scorers.{scorer}.find_weights", none)
    monkeypatch.setattr("endoprior.evaluation.scorers.motion.import_torchvision", MagicMock)
    result = evaluate(still_scene(phantom), phantom, speed=False, **({"download": True} if asked else {}))
    assert {"lpips", "flow_error"} <= result.skipped.keys()
    assert sought == {"AlexNet": asked, "SqueezeNet 1.1": False, "RAFT-large": asked, "RAFT-small": False}


def test_carried_points_follow_a_common_motion(phantom):
    scene = still_scene(phantom)
    motion = scene.gaussians["motion"]
    with torch.no_grad():
        motion[:, :, 0] = 1.5  # the same shift of x in every basis function
    times = [0.1, 0.5, 0.9]
    shift = [scene.at(t).means[0, 0].item() - scene.gaussians["means"][0, 0].item() for t in times]
    start = scene.at(0.5).means[:5].numpy().astype(np.float64)
    carried = carry_points(scene, start, np.full(5, 1), times)
    for k in range(3):
        expected = start + np.array([shift[k] - shift[1], 0, 0])
        assert carried[k] == pytest.approx(expected, abs=1e-4)  # float32 centers near 100 mm


def test_track_error_of_a_still_scene_is_how_far_the_tissue_moved(phantom):
    tracks = phantom.truth.tracks
    followed = tracks.visible.sum(0) > 1
    points, visible = tracks.points[:, followed], tracks.visible[:, followed].copy()
    first, columns = visible.argmax(0), np.arange(followed.sum())
    visible[first, columns] = False
    moved = np.linalg.norm(points - points[first, columns], axis=-1)[visible].mean()
    true = true_tracks(phantom)
    parts = parts_of(true, phantom)
    scores = track_scores(by_scene(still_scene(phantom), true, phantom), true, parts)
    assert scores["track_error_mm"] == pytest.approx(moved, rel=1e-3)


def test_a_point_of_the_scene_is_hidden_under_the_tool_mask_or_behind_tissue(phantom, monkeypatch):
    scene, true = still_scene(phantom), true_tracks(phantom)
    shown = by_scene(scene, true, phantom)
    for frame in phantom.frames("video"):
        x, y = np.floor(shown.pixels[frame.index]).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < 96) & (y < 80)
        under_tool = ~frame.tissue_mask[y[inside], x[inside]]
        assert under_tool.any() and not shown.visible[frame.index][inside][under_tool].any()
    assert shown.visible.mean() > 0.05  # few untrained Gaussians leave holes
    starts = true.at_start(true.points)
    monkeypatch.setattr(
        "endoprior.evaluation.scorers.tracks.carry_points", lambda *_: np.tile(1.2 * starts, (10, 1, 1))
    )
    assert by_scene(scene, true, phantom).visible.mean() < 0.01, "a fifth deeper than the tissue"


def test_unpaired_points_are_held_against_the_nearest_end(phantom, monkeypatch):
    tracks, scene = phantom.truth.tracks, still_scene(phantom)
    start, end = tracks.points[0, :6], tracks.points[0, :6] + np.float32([0, 0, 3])
    points = np.zeros((len(phantom), 12, 3), np.float32)
    visible = np.zeros(points.shape[:2], bool)
    points[0, :6], points[-1, 6:], visible[0, :6], visible[-1, 6:] = start, end[::-1], True, True
    unpaired = Tracks(points, visible, paired=False)
    monkeypatch.setattr(type(phantom.truth), "tracks", property(lambda self: unpaired))
    nearest = np.linalg.norm(start[:, None] - end, axis=-1).min(1).mean()
    assert track_end_error_mm(scene, phantom) == pytest.approx(nearest, rel=1e-4)
    assert true_tracks(phantom) is None


def test_truth_gives_its_scores_and_no_truth_gives_none(phantom, tiny_sequence):
    cfg = preset("default")
    cfg = replace(
        cfg, init=replace(cfg.init, budget=400), schedule=replace(cfg.schedule, coarse_iterations=0, fine_iterations=5)
    )
    names = {
        "psnr_behind_tool",
        "psnr_behind_tool_guessed",
        "depth_rmse_behind_tool_mm",
        "psnr_no_highlights",
        "track_error_mm",
        "track_error_px",
    }
    names |= {"track_fold_rate", "track_tear_rate", "track_average_jaccard_dis", "track_error_p90_px_still"}
    scores = evaluate(train(phantom, cfg), phantom, networks=False).scores
    assert names <= set(scores) and all(np.isfinite(scores[name]) for name in names)
    plain = load_sequence(tiny_sequence)
    assert not names & set(evaluate(train(plain, cfg), plain, networks=False).scores)


def test_training_frames_and_depth_by_alpha_are_scored_beside(phantom):
    scene = still_scene(phantom)
    found = evaluate(scene, phantom, networks=False).scores
    trained = evaluate(scene, phantom, "train", networks=False, speed=False)
    assert found["fps"] > 0 and "fps" not in trained.scores and "not asked for" in trained.skipped["fps_cached"]
    assert len(phantom.indices("train")) <= 8 and found["psnr_train"] == trained.scores["psnr_tissue"]
    assert "psnr_train" in trained.skipped
    by_hand = []
    for frame in phantom.frames("test"):
        out, counted = scene.render(frame.time, frame.camera), frame.tissue_mask & frame.depth_valid
        depth = out.depth.numpy()[counted] / np.maximum(out.alpha.numpy()[counted], 1e-6)
        by_hand.append(np.sqrt(np.mean((depth.astype(np.float64) - frame.depth[counted]) ** 2)))
    assert found["depth_rmse_by_alpha_mm"] == pytest.approx(np.mean(by_hand), rel=1e-6)
    assert found["depth_rmse_by_alpha_mm"] < found["depth_rmse_mm"], "first Gaussians are thin"


@pytest.mark.slow
def test_demo_leaves_what_it_promises(tmp_path, monkeypatch):
    """The demo's path at a small size; its full size is `make demo`."""
    from endoprior import phantom as package

    def small(out, cfg, progress=None):
        write_phantom(out, replace(cfg, width=96, height=80), *[progress] * (progress is not None))

    quick = preset("default")
    quick = replace(
        quick,
        init=replace(quick.init, budget=300),
        schedule=replace(quick.schedule, coarse_iterations=0, fine_iterations=10, half_resolution_iterations=0),
    )
    monkeypatch.setattr(package, "write_phantom", small)
    monkeypatch.setattr("endoprior.cli.phantom.preset", lambda name: quick)
    assert main(["demo", str(tmp_path / "demo"), "--frames", "10"]) == 0
    for part in (
        "report.png",
        "run/video.mp4",
        "run/metrics.json",
        "run/scene.safetensors",
        "sequence/truth/tracks.npz",
    ):
        assert (tmp_path / "demo" / part).stat().st_size > 0
    assert "track_error_mm" in json.loads((tmp_path / "demo" / "run" / "metrics.json").read_text())["scores"]


def test_frames_far_below_the_median_are_named():
    rows = [
        {"index": i, "psnr_tissue": value} for i, value in ((1, 34.0), (9, 33.0), (17, 29.9), (25, None), (33, 35.0))
    ]
    assert Evaluation({}, per_frame=rows).outlier_frames() == [17]
    assert Evaluation({}).outlier_frames() == []
