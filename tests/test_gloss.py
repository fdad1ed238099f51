"""Gloss: what the right eye sees more than the left one, of scenes trained on both eyes."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from conftest import write_tiny_sequence
from method_runs import trained_and_resumed
from tiny_training import tiny_config

from endoprior import preset, train
from endoprior.core.geometry import right_camera, share_of_right
from endoprior.core.types import Camera
from endoprior.data import load_sequence
from endoprior.model.colors import with_fixed_color
from endoprior.model.gaussians import Gaussians, change_layout
from endoprior.model.highlights import without_highlights
from endoprior.model.playback import Playback
from endoprior.model.scene_file import load_scene

BASELINE, FRAME = 4.0, 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The tiny sequence with right pictures that are white everywhere: all of it is gloss."""
    path = tmp_path_factory.mktemp("gloss") / "tiny"
    write_tiny_sequence(path)
    (path / "right").mkdir()
    for image in (path / "images").iterdir():
        assert cv2.imwrite(str(path / "right" / image.name), np.full((40, 48, 3), 255, np.uint8))
    facts = path / "sequence.json"
    facts.write_text(json.dumps(json.loads(facts.read_text()) | {"baseline_mm": BASELINE}))
    return path


@pytest.fixture(scope="module")
def scene(folder):
    cfg = preset("default").replace({"iterations": 60, "gaussians": 300, "data.eyes": "both"})
    return train(load_sequence(folder), cfg)


def test_a_camera_has_a_share_of_the_right_eye():
    turn = cv2.Rodrigues(np.array([0.2, -0.3, 0.1]))[0]
    pose = np.block([[turn, np.array([[5.0], [-2.0], [9.0]])], [np.zeros((1, 3)), np.ones((1, 1))]])
    left = Camera(64, 48, 50, 55, 30, 25, pose)
    found = [share_of_right(right_camera(left, mm), left, BASELINE) for mm in (-3, 0, 1, 4, 6, 20)]
    assert np.allclose(found, [0, 0, 0.25, 1, 0.5, 0])


def test_each_eye_sees_its_own_color(scene):
    time, left = FRAME / len(scene.cameras), scene.cameras[FRAME]
    first, second = (scene.render(time, camera).color for camera in (left, right_camera(left, BASELINE)))
    plain = replace(scene, baseline_mm=0.0)
    assert torch.equal(first, plain.render(time, left).color) and torch.equal(first, scene.render(time).color)
    assert second.mean() > plain.render(time, right_camera(left, BASELINE)).color.mean() + 0.02
    change = scene.offsets(scene.gaussians, time).gloss[:, None].detach()
    assert change.abs().max() > 0.01  # it changes with time
    gloss = scene.gaussians["gloss"] + torch.cat([change, torch.zeros(len(change), 2, 3)], 1)
    between, seen_left = scene.at(time, right_camera(left, BASELINE / 4)), scene.at(time)
    assert torch.allclose(between.sh, seen_left.sh + 0.25 * gloss[:, :1], atol=1e-6) and gloss.abs().max() > 0.05
    assert torch.allclose(between.color_slopes, seen_left.color_slopes + 0.25 * gloss[:, 1:], atol=1e-6)


def test_several_and_kept_pictures_are_those_of_the_scene(scene):
    time, right = FRAME / len(scene.cameras), right_camera(scene.cameras[FRAME], BASELINE)
    want = scene.render(time, right).color
    assert torch.equal(scene.render_many([time], [right])[0].color, want)
    assert torch.equal(Playback(scene).render(FRAME, right).color, want)


def test_without_highlights_both_eyes_see_the_same_tissue(scene, folder):
    time, right = FRAME / len(scene.cameras), right_camera(scene.cameras[FRAME], BASELINE)
    tissue = without_highlights(scene, lambda _: load_sequence(folder).frames("train"))
    assert torch.equal(tissue.at(time, right).sh, tissue.at(time).sh)


def test_fixed_colors_of_the_right_eye_are_fixed_too(scene):
    still = with_fixed_color(scene, [0.2, 0.7])
    first, second = (still.at(time, right_camera(still.cameras[FRAME], BASELINE)).sh for time in (0.2, 0.7))
    assert torch.equal(first, second) and not torch.equal(still.at(0.2).sh, first)


def test_gloss_is_saved_and_resumed(folder, tmp_path):
    cfg = tiny_config("basis")
    both = replace(cfg, data=replace(cfg.data, eyes="both"))
    found = trained_and_resumed(load_sequence(folder), both, tmp_path, 9)
    assert found.baseline_mm == BASELINE and found.gaussians["gloss"].abs().max() > 0


def test_a_scene_from_before_there_was_gloss_has_one_color(scene, tmp_path):
    tensors = {name: value for name, value in scene.gaussians.tensors.items() if name != "gloss"}
    tensors["changes"] = tensors["changes"][..., : change_layout(scene.config)["gloss"].start]
    replace(scene, gaussians=Gaussians(tensors), baseline_mm=0.0).save(tmp_path / "scene.safetensors")
    found = load_scene(tmp_path)
    time, right = FRAME / len(scene.cameras), right_camera(scene.cameras[FRAME], BASELINE)
    assert torch.equal(found.at(time, right).sh, scene.at(time).sh)


def test_one_eye_has_no_gloss(folder):
    assert "gloss" not in train(load_sequence(folder), tiny_config("basis")).gaussians.tensors
