"""Scenes of several windows: where a sequence is cut, how one fades into the next, and what is carried across."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.core.types import Camera, Splats
from endoprior.data import load_sequence, window_plan
from endoprior.data.window_plan import FrameSummaries, plan_windows, summarize_frames
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.carry import carry, carry_points, centers_then
from endoprior.model.colors import with_fixed_color
from endoprior.model.gaussians import Offsets
from endoprior.model.playback import Playback
from endoprior.model.presets import preset
from endoprior.model.scene import SingleScene, faded, faded_in, joined
from endoprior.model.scene_file import load_scene
from endoprior.model.surface import Support
from endoprior.model.windowed_scene import Span, WindowedScene, save_index, window_file
from endoprior.view.viewable import ViewSettings
from endoprior.view.viewable_scene import ViewableScene

LONGEST, SHORTEST, OVERLAP = 40, 10, 4
SPEED_MM = 0.4
"""Per frame, to the right."""


@dataclass(frozen=True)
class Sliding:
    """A deformation: everything moves to the right from frame `start` on."""

    start: int
    num_frames: int

    def offsets(self, means, time, ops):
        step = torch.zeros_like(means)
        step[:, 0] = SPEED_MM * (self.start + time * self.num_frames)
        return Offsets(means=step, log_scales=None, quats=None, opacity_logits=None, sh_dc=None)

    def to(self, device, **_):
        return self


def camera_at(turn_deg: float = 0.0, x_mm: float = 0.0) -> Camera:
    angle, pose = np.radians(turn_deg), np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[0, 3] = -x_mm
    return Camera(64, 48, 80.0, 80.0, 32.0, 24.0, pose)


def summaries(num: int, change_from: int | None = None) -> FrameSummaries:
    thumbnails = np.full((num, 2, 2, 3), 0.4, np.float32)
    if change_from is not None:
        thumbnails[change_from:] += 0.06
    return FrameSummaries(thumbnails, np.full(num, 100.0))


def wall(start: int, stop: int, *, slides: bool = True) -> SingleScene:
    """An opaque wall, the same in every window, that slides."""
    field, cfg = None, preset("default").fitted(stop - start)
    if slides:
        field = Sliding(start, stop - start)
        cfg = cfg.replace({"init.motion": "rest", "deformation.kind": "hexplane"})
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-30, 30, 41), np.linspace(-22, 22, 31)))
    points = np.column_stack([x, y, 80 + 0.1 * x]).astype(np.float32)
    colors = np.stack([0.5 + 0.3 * np.sin(x / 4), 0.4 + 0.2 * np.cos(y / 5), 0.3 + 0 * x], 1)
    gaussians = create_gaussians(points, colors, np.full(len(points), 0.4, np.float32), cfg)
    with torch.no_grad():
        gaussians["opacity_logits"].fill_(5.0)
    cameras = tuple(camera_at() for _ in range(stop - start))
    score, count = torch.zeros(len(points)), torch.ones(len(points))
    return SingleScene(gaussians, field, cfg, cameras, 25.0, score, count)


def windowed(*ends: tuple[int, int]) -> WindowedScene:
    scenes = [wall(*each) for each in ends]
    spans = tuple(Span(a, b, len(scene)) for (a, b), scene in zip(ends, scenes, strict=True))
    cameras = tuple(camera_at() for _ in range(ends[-1][1]))
    return WindowedScene(scenes[0].config, cameras, 25.0, spans, scenes.__getitem__)


@pytest.fixture(scope="module")
def three() -> WindowedScene:
    return windowed((0, 20), (14, 34), (28, 40))


@pytest.mark.parametrize(
    ("cameras", "seen", "starts"),
    [
        ([camera_at() for _ in range(35)], summaries(35), [0]),
        ([camera_at(turn_deg=0.97 * i) for i in range(36)], summaries(36), [0, 16]),
        ([camera_at(turn_deg=2 * i) for i in range(36)], summaries(36), [0, 10, 20]),
        ([camera_at(x_mm=0.6 * i) for i in range(36)], summaries(36), [0, 17]),
        ([camera_at(x_mm=0.01 * i) for i in range(36)], summaries(36, 12), [0, 12]),
        ([camera_at() for _ in range(36)], summaries(36, 12), [0]),
        ([camera_at() for _ in range(100)], summaries(100), [0, 36, 72]),
        ([camera_at() for _ in range(44)], summaries(44), [0, 34]),
    ],
    ids=[
        "short and still",
        "turned",
        "turning fast",
        "moved",
        "picture",
        "picture of a still camera",
        "long",
        "a little too long",
    ],
)
def test_where_a_sequence_is_cut(cameras, seen, starts, monkeypatch):
    monkeypatch.setattr(window_plan, "SHORTEST", SHORTEST)
    monkeypatch.setattr(window_plan, "OVERLAP", OVERLAP)
    plan = plan_windows(cameras, seen, LONGEST)
    assert [start for start, _ in plan] == starts
    assert plan[-1][1] == len(cameras)
    assert all(stop == following + OVERLAP for (_, stop), (following, _) in pairwise(plan))
    assert all(SHORTEST <= stop - start <= LONGEST for start, stop in plan)
    assert plan_windows(cameras, seen, 0) == [(0, len(cameras))]


def test_without_depth_only_turns_pictures_and_length_cut():
    cameras = [camera_at(x_mm=5.0 * i) for i in range(36)]
    assert plan_windows(cameras, replace(summaries(36), depth_mm=np.full(36, np.nan)), LONGEST) == [(0, 36)]


def test_held_out_frames_do_not_decide_where_to_cut(make_tiny_sequence):
    sequence = load_sequence(make_tiny_sequence(num_frames=12)).training_view()
    seen = summarize_frames(sequence)  # reading a held-out frame would raise
    assert (seen.thumbnails[9] == seen.thumbnails[8]).all() and (seen.thumbnails[8] != seen.thumbnails[7]).any()


def test_one_window_fades_into_the_next(three):
    for frame in range(40):
        shown = three.shown_at(frame / 40)
        assert sum(part.weight for part in shown) == pytest.approx(1)
        assert len(shown) == (2 if 16 <= frame < 18 or 30 <= frame < 32 else 1)
        for part in shown:
            at = part.window.start + part.time * (part.window.stop - part.window.start)
            assert at == pytest.approx(frame)
    into = [sum(part.weight for part in three.shown_at(f / 40) if part.window.start == 14) for f in range(14, 20)]
    np.testing.assert_allclose(into, [0, 0, 1 / 3, 2 / 3, 1, 1], atol=0.01)
    assert faded_in(0.25) == 0 and faded_in(0.5) == 0.5 and faded_in(0.75) == 1


def test_fading_halves_the_optical_depth():
    splats = Splats(*(torch.rand(5, n) for n in (3, 4, 3)), torch.rand(5), torch.rand(5, 1, 3))
    halves = [faded(splats, 0.3), faded(splats, 0.7)]
    passed = (1 - halves[0].opacities) * (1 - halves[1].opacities)
    torch.testing.assert_close(passed, 1 - splats.opacities)
    assert len(joined(halves)) == 10 and joined(halves).color_slopes is None


def test_equal_windows_show_no_seam(three):
    """The wall slides past the camera at one speed, in the overlaps too."""
    whole = wall(0, 40)
    for frame in (0, 13, 14, 17, 19.5, 20, 31, 39):
        want, got = whole.render(frame / 40), three.render(frame / 40)
        solid = want.alpha > 0.999  # where the wall ends, its Gaussians fade more slowly than their centers
        assert solid.float().mean() > 0.5 and (got.alpha > 0.99)[solid].all()
        assert (got.color - want.color)[solid].abs().max() < 0.05
        assert (got.depth / got.alpha - want.depth / want.alpha)[solid].abs().max() < 0.3


def test_a_picture_of_two_windows_is_the_mean_of_theirs(three):
    """By `render`, `render_many` and `Playback` alike."""
    frame, camera = 17, three.cameras[17]
    parts = three.shown_at(frame / 40)
    views = [part.window.scene.render(part.time, camera) for part in parts]
    found = three.render_many([frame / 40, 0.0], [camera, camera])[0]
    for name in ("unclamped_color", "depth", "alpha"):
        want = sum(part.weight * getattr(view, name) for part, view in zip(parts, views, strict=True))
        for got in (three.render(frame / 40), found, Playback(three).render(frame)):
            torch.testing.assert_close(getattr(got, name), want)
    assert len(Playback(three).splats(frame)) == 2 * 1271


def test_points_are_carried_from_window_to_window(three):
    frames = np.arange(40)
    points = np.array([[0.0, 0, 80], [5, 4, 80.5], [-3, 2, 79.7]])
    home = np.array([2, 17, 36])
    carried = carry(three, points, home, (frames / 40).tolist())
    want = points + np.array([1, 0, 0]) * SPEED_MM * (frames[:, None] - home)[..., None]
    np.testing.assert_allclose(carried.positions, want, atol=1e-3)
    assert (np.diff(carried.spread_px[:, 0])[[16, 30]] > 0.1).all(), "tied anew, so less sure"
    assert carried.spread_px[2, 0] == pytest.approx(carried.spread_px[15, 0], abs=1e-3)
    whole = carry_points(wall(0, 40), points, home, (frames / 40).tolist())
    np.testing.assert_allclose(carried.positions, whole, atol=1e-3)


def test_where_the_gaussians_of_a_time_were_before(three):
    then = centers_then(three, 36 / 40, 3 / 40)
    now = three.at(36 / 40).means.numpy()
    inner = np.abs(then[:, 0]) < 12
    np.testing.assert_allclose((now - then)[inner], [[33 * SPEED_MM, 0, 0]] * inner.sum(), atol=0.05)


def test_changes_reach_every_window(three):
    plain = with_fixed_color(three, [0.1])
    assert [len(window.scene) for window in plain.windows] == [1271] * 3
    assert torch.equal(plain.at(0.9).sh, three.at(0.9).sh), "the colors of the wall never change"


def test_the_support_of_a_time_is_that_of_the_windows_shown(three):
    support = Support(three, lambda window: [])
    assert len(support.share(0.0)) == 1271 and len(support.share(16 / 40)) == 2 * 1271
    assert np.isinf(support.gap(16 / 40)).all() and (support.num_frames(0.0) == 0).all()


def stored(folder: Path) -> Path:
    """A run folder with two windows of resting scenes."""
    parts = [wall(*ends, slides=False) for ends in ((0, 12), (8, 20))]
    spans = (Span(0, 12, len(parts[0])), Span(8, 20, len(parts[1])))
    cfg = preset("default")
    scene = WindowedScene(cfg, tuple(camera_at(x_mm=i) for i in range(20)), 25.0, spans, parts.__getitem__)
    scene.save(folder / "scene.safetensors")
    return folder


def test_a_chosen_backend_is_kept(tmp_path):
    windowed = load_scene(stored(tmp_path / "run"))
    for scene in (windowed, windowed.windows[0].scene):
        chosen = scene.to("cpu", backend="reference")
        assert chosen.to("cpu").backend == chosen.to(torch.device("cpu")).backend == "reference"
        assert chosen.to("cpu", backend="numba").backend == "numba" and scene.to("cpu") is scene


def test_a_saved_scene_comes_back(tmp_path):
    scene = load_scene(stored(tmp_path / "run"))
    assert isinstance(scene, WindowedScene) and len(scene) == 2 * 1271
    assert [camera.center[0] for camera in scene.cameras] == list(range(20))
    again = tmp_path / "again/scene.safetensors"
    again.parent.mkdir()
    scene.save(again)
    for time in (0.0, 0.47, 0.9):
        assert torch.equal(load_scene(again).render(time).color, scene.render(time).color)
    assert again.read_bytes() == (tmp_path / "run/scene.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("spans", "message"),
    [
        (((0, 12, 5), (13, 20, 5)), "expected windows in order"),
        (((0, 12, 5), (8, 19, 5)), "expected frames 0 to 20"),
        (((1, 12, 5), (8, 20, 5)), "expected frames 0 to 20"),
        (((0, 20, 5), (8, 20, 5)), "expected windows in order"),
        (((0, 9, 5), (4, 14, 5), (8, 20, 5)), "expected windows in order"),
        (((0, 12, -1), (8, 20, 5)), "expected counts of Gaussians"),
    ],
)
def test_a_list_of_windows_that_cannot_be(tmp_path, spans, message):
    run = stored(tmp_path / "run")
    save_index(run / "scene.safetensors", replace(load_scene(run), spans=tuple(Span(*span) for span in spans)))
    with pytest.raises(InputError, match=message):
        load_scene(run)


def test_a_window_that_is_missing_or_another_one_is_named(tmp_path):
    run = stored(tmp_path / "run")
    first, second = (window_file(run / "scene.safetensors", k) for k in (0, 1))
    shutil.copy(run / "scene.safetensors", second)
    with pytest.raises(InputError, match=r"001.*expected 12 frames and 1271 Gaussians|001.*1,271"):
        load_scene(run).render(0.9)
    first.unlink()
    with pytest.raises(InputError, match="000"):
        load_scene(run).render(0.0)


def test_a_part_of_a_sequence_holds_out_the_same_frames(make_tiny_sequence):
    folder = make_tiny_sequence(num_frames=20)
    whole, part = load_sequence(folder), load_sequence(folder, DataConfig(window="5-18"))
    assert len(part) == 14 and [i + 5 for i in part.indices("test")] == [9, 17]
    assert (part.frame(4).rgb_u8 == whole.frame(9).rgb_u8).all()
    assert part.frame(4).index == 4 and part.frame(4).time == pytest.approx(4 / 14)
    with pytest.raises(ValueError, match="held out"):
        part.training_view().frame(4)
    again = whole.part(2, 20).part(3, 17)
    assert [i + 5 for i in again.indices("test")] == [9, 17]


@pytest.mark.parametrize("window", ["5", "18-5", "5-20", "2-5,9-12", "5-5"])
def test_a_window_that_is_no_range_of_frames(make_tiny_sequence, window):
    with pytest.raises(InputError, match=r"data\.window: expected two frames within 0 to 19"):
        load_sequence(make_tiny_sequence(num_frames=20), DataConfig(window=window))
    with pytest.raises(ValueError, match="window must look like"):
        DataConfig(window="a-b")


@pytest.mark.parametrize("layer", ["color", "depth", "alpha", "displacement", "stretch", "prior"])
def test_the_viewer_shows_every_layer_of_windows(three, layer):
    """Inside a window, where two overlap, and in another window than the reference frame's."""
    viewable = ViewableScene(three, "three windows")
    for frame in (3, 16, 37):
        settings = ViewSettings(frame=frame, layer=layer, since=2)
        picture = viewable.picture(settings, three.cameras[frame])
        assert picture.shape == (48, 64, 3) and picture.max() > 0, frame
    settings = ViewSettings(frame=37, layer="displacement", since=2)
    assert "14.8 mm" in viewable.legend(settings), "37 frames of 0.4 mm, to the last one"
    assert len(viewable.follow(np.array([[0.0, 0, 80]]), [16]).positions) == 40
