"""Playing from kept frames: the same pictures, within the memory allowed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from endoprior.core.checks import InputError
from endoprior.core.config import Config
from endoprior.core.types import Camera
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.carry import carry_points
from endoprior.model.gaussians import Gaussians
from endoprior.model.playback import Playback
from endoprior.model.presets import preset
from endoprior.model.scene import Scene, SingleScene
from endoprior.model.scene_file import load_scene

NUM_FRAMES = 5


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A hundred Gaussians that move at random, seen by five cameras."""
    cfg: Config = preset("default").fitted(20)
    rng = np.random.default_rng(0)
    points = rng.uniform([-15, -12, 50], [15, 12, 60], (100, 3)).astype(np.float32)
    gaussians = create_gaussians(points, rng.random((100, 3), np.float32), np.zeros(100, np.float32), cfg)
    with torch.no_grad():
        gaussians["motion"].copy_(torch.from_numpy(rng.normal(size=gaussians["motion"].shape) * 0.3))
    camera = Camera(64, 48, 80.0, 80.0, 32.0, 24.0, np.eye(4))
    return SingleScene(gaussians, None, cfg, (camera,) * NUM_FRAMES, 25.0, torch.zeros(100), torch.zeros(100))


def pictures_equal(a, b) -> bool:
    """Whether two renderings agree to the bit."""
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("color", "depth", "alpha"))


def test_kept_frames_draw_as_the_scene_does(scene):
    playback = Playback(scene)
    for _ in range(2):
        for i in range(NUM_FRAMES):
            assert pictures_equal(playback.render(i), scene.render(i / NUM_FRAMES))
    assert not pictures_equal(playback.render(0), playback.render(3))


def test_color_is_an_image_and_the_unclamped_one_is_at_hand(scene):
    gaussians = {name: value.detach().clone() for name, value in scene.gaussians.tensors.items()}
    gaussians["sh_dc"] += 10.0
    bright = replace(scene, gaussians=Gaussians(gaussians))
    views = (bright.render(0.4), *bright.render_many([0.4], [bright.camera_at(0.4)]), Playback(bright).render(2))
    for view in views:
        assert view.unclamped_color.max() > 1.02 and view.color.max() == 1 and view.color.min() >= 0
        assert torch.equal(view.color, view.unclamped_color.clamp(0, 1))


def test_several_frames_at_once_are_the_frames(scene):
    many = Playback(scene).render_many([3, 0, 4])
    assert all(pictures_equal(a, scene.render(i / NUM_FRAMES)) for a, i in zip(many, (3, 0, 4), strict=True))
    times, cameras = [0.1, 0.7], list(scene.cameras[:2])
    for got, time in zip(scene.render_many(times, cameras), times, strict=True):
        assert pictures_equal(got, scene.render(time))


def test_a_frame_is_deformed_once(scene, monkeypatch):
    asked = []
    original = SingleScene.at
    monkeypatch.setattr(SingleScene, "at", lambda self, time, *eye: asked.append(time) or original(self, time, *eye))
    playback = Playback(scene)
    for i in (0, 1, 0, 1, 1):
        playback.render(i)
    assert asked == [0.0, 1 / NUM_FRAMES]


def test_the_frame_not_drawn_for_longest_goes_first(scene, monkeypatch):
    asked = []
    original = SingleScene.at
    monkeypatch.setattr(
        SingleScene, "at", lambda self, time, *eye: asked.append(round(time * NUM_FRAMES)) or original(self, time, *eye)
    )
    one = Playback(scene)
    one.splats(0)
    size = sum(t.numel() * 4 for t in vars(one.splats(0)).values())
    playback = Playback(scene, max_bytes=2 * size + 8)
    asked.clear()
    for i in (0, 1, 0, 2, 0, 1):
        playback.splats(i)
    assert asked == [0, 1, 2, 1]
    tight = Playback(scene, max_bytes=0)
    assert pictures_equal(tight.render(1), scene.render(1 / NUM_FRAMES))


def test_the_camera_of_the_nearest_frame(scene):
    cameras = tuple(replace(scene.cameras[0], cx=30.0 + i) for i in range(NUM_FRAMES))
    numbered = replace(scene, cameras=cameras)
    nearest = [numbered.camera_at(time).cx - 30 for time in (-0.3, 0.0, 0.29, 0.31, 1.0, 1.2)]
    assert nearest == [0, 0, 1, 2, NUM_FRAMES - 1, NUM_FRAMES - 1]


def test_another_camera_and_no_such_frame(scene):
    playback = Playback(scene)
    wide = replace(scene.cameras[0], width=80, cx=40.0)
    assert playback.render(2, wide).color.shape == (48, 80, 3)
    with pytest.raises(IndexError, match=r"0\.\.4"):
        playback.render(NUM_FRAMES)


@pytest.mark.parametrize(
    "trained, asked, on_gpu, want",
    [("numba", None, False, "numba"), ("numba", None, True, "gsplat"), ("numba", "triton", True, "triton"),
     ("triton", None, True, "triton"), ("triton", None, False, "numba"), ("reference", None, False, "reference"),
     ("gsplat", "triton", True, "triton"), ("gsplat", "triton", False, "numba")],
)  # fmt: skip
def test_what_draws_a_scene_fits_its_device(scene, trained, asked, on_gpu, want):
    config = replace(scene.config, render=replace(scene.config.render, backend=trained))
    moved = replace(scene, config=config).to("meta" if on_gpu else "cpu", backend=asked)
    assert moved.backend == want


def test_motion_is_held_beyond_the_trained_times(scene, tmp_path):
    """In pictures and in carried points, and again after it was saved."""
    held = replace(scene, trained_from=0.2, trained_until=0.7)
    held.save(tmp_path / "scene.safetensors")
    for found in (held, load_scene(tmp_path)):
        for time, same in ((0.0, 0.2), (0.1, 0.2), (0.5, 0.5), (0.8, 0.7), (1.0, 0.7)):
            assert torch.equal(found.at(time).means, scene.at(same).means)
        moved = carry_points(found, scene.at(0.2).means.numpy()[:3], np.zeros(3, int), [0.0, 0.7, 1.0])
        assert np.array_equal(moved[1], moved[2]) and not np.array_equal(moved[0], moved[1])


def test_a_scene_that_was_never_trained_is_rejected(scene, tmp_path):
    replace(scene, trained_from=0.8, trained_until=0.7).save(tmp_path / "scene.safetensors")
    with pytest.raises(InputError, match="trained_until"):
        load_scene(tmp_path)
