"""Kinds of tissue: their colors against those of bowel, smoke over time, blood; shapes stay what they are."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.phantom.camera import AT_ORIGIN, CameraPose
from endoprior.phantom.config import Tissue
from endoprior.phantom.raster import FAR
from endoprior.phantom.scene import SceneState, Smoke, build_scene
from endoprior.phantom.sensor import develop, exposure_gain, metered, next_gain, vignette
from endoprior.phantom.surface import build_anatomy, organs_at
from endoprior.phantom.texture import LOOKS, bled
from endoprior.phantom.views import render_view

SMALL = PhantomConfig(frames=48, width=96, height=80, seed=3)
KINDS = get_args(Tissue)


@pytest.fixture(scope="module")
def scenes():
    """One small scene of each kind."""
    return {kind: build_scene(replace(SMALL, tissue=kind)) for kind in KINDS}


@pytest.fixture(scope="module")
def views(scenes):
    """What the left camera sees in the first frame."""
    return {kind: render_view(scene, SceneState.of(scene, 0.0), AT_ORIGIN) for kind, scene in scenes.items()}


@pytest.fixture(scope="module")
def pictures(scenes, views):
    """(H, W, 3) display values in [0, 255] without tools."""
    lens = vignette(SMALL.width, SMALL.height)
    gains = {kind: exposure_gain(view.tissue) * scenes[kind].look.exposure for kind, view in views.items()}
    return {kind: develop(view.tissue, gains[kind], lens) for kind, view in views.items()}


def medians(pictures, kind):
    """Median red, green and blue."""
    return np.median(pictures[kind].reshape(-1, 3), 0)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_renders_with_exact_masks(views, pictures, kind):
    view = views[kind]
    assert 0.05 < (view.tool_share > 0).mean() < 0.35
    assert np.array_equal(view.tool_share > 0, view.tool_depth < FAR)
    assert np.array_equal(view.image[view.tool_share == 0], view.tissue[view.tool_share == 0])
    assert 40 < pictures[kind].mean() < 150 and pictures[kind].std() > 15


def test_colors_are_those_of_the_names(pictures):
    red, green, blue = medians(pictures, "fat")
    assert red > green > 1.35 * blue  # yellow
    red, green, blue = medians(pictures, "bowel")
    assert red > 1.3 * max(green, blue)
    pale = medians(pictures, "pale")
    assert pale[0] / pale[2] < 0.85 * red / blue  # less color
    purple = medians(pictures, "purple")
    assert purple[0] > purple[2] > 1.02 * purple[1] and purple.mean() < 0.92 * np.mean([red, green, blue])
    liver = medians(pictures, "liver")
    assert liver[0] > 1.2 * liver[1] > 1.2 * 1.05 * liver[2] and liver.mean() < 0.92 * np.mean([red, green, blue])
    warm = medians(pictures, "warm")
    assert warm[2] / warm[0] < 0.85 * blue / red and warm[1] > 1.1 * warm[2]  # orange


def test_warm_light_falls_on_tools_too(views):
    inside = views["bowel"].tool_share == 1
    ratio = views["warm"].image[inside] / views["bowel"].image[inside]
    assert np.allclose(ratio, LOOKS["warm"].light, rtol=1e-4)


def test_shapes_are_those_of_bowel_but_a_liver_is_smoother(scenes):
    want = scenes["bowel"].height
    for kind, scene in scenes.items():
        assert np.array_equal(scene.height, want) == (kind != "liver"), kind
    rough = {kind: np.abs(np.diff(scenes[kind].height, 2)).mean() for kind in ("bowel", "liver")}
    assert rough["liver"] < 0.6 * rough["bowel"]
    # The grasper holds the smoothed surface.
    pull = scenes["liver"].motion.pulls[0]
    near = np.argmin(np.hypot(scenes["liver"].a - pull.center[0], scenes["liver"].b - pull.center[1]))
    assert pull.height == scenes["liver"].height.flat[near]
    assert pull.height != scenes["bowel"].motion.pulls[0].height


def test_smoke_comes_and_goes(scenes):
    smoke = scenes["smoke"].smoke
    density = np.array([smoke.density(k / 47) for k in range(48)])
    assert density[0] == density[-1] == 0 and density.max() > 0.5
    assert np.abs(np.diff(density)).max() < 0.15
    long = Smoke.of(replace(SMALL, frames=400), 0.6)
    thick = np.array([long.density(k / 399) for k in range(400)]) > 0.3
    assert np.count_nonzero(np.diff(thick.astype(int)) == 1) == 10


def test_smoke_veils_tissue_and_tools_alike_and_drifts(scenes):
    scene, times = scenes["smoke"], (0.40, 0.48)
    clear = [render_view(replace(scene, smoke=None), SceneState.of(scene, t), AT_ORIGIN) for t in times]
    veiled = [render_view(scene, SceneState.of(scene, t), AT_ORIGIN) for t in times]
    for before, after in zip(clear, veiled, strict=True):
        tool = before.tool_share == 1
        assert np.array_equal(before.tool_share, after.tool_share)
        lost, at = {}, times[0] if after is veiled[0] else times[1]
        want = scene.smoke.veiled(before.image, before.tool_depth, at, AT_ORIGIN, SMALL.focal, SMALL.center)
        error = np.abs(after.image - want)[tool] / np.abs(want - before.image)[tool].mean()
        assert np.median(error) < 0.04  # clouds are sampled more coarsely at this size
        for name, where in (("tool", tool), ("tissue", before.tool_share == 0)):
            lost[name] = after.image[where].std() / before.image[where].std()
        assert lost["tool"] < 0.9 and lost["tissue"] < 0.8  # less contrast
    veil = [after.tissue.mean(-1) - before.tissue.mean(-1) for before, after in zip(clear, veiled, strict=True)]
    assert np.corrcoef(veil[0].ravel(), veil[1].ravel())[0, 1] < 0.995 and np.abs(veil[0] - veil[1]).mean() > 0.002


def test_smoke_closed_form():
    # By the law of Beer and Lambert, twice the way lets the square through.
    smoke = Smoke.of(SMALL, 0.6)
    black = np.zeros((32, 32, 3), np.float32)
    eye, grid = CameraPose.moved_right(0.0), (40.0, (16.0, 16.0))
    near, far = (smoke.veiled(black, np.full((32, 32), z, np.float32), 0.45, eye, *grid) for z in (40.0, 80.0))
    unit = far[..., 0] / far[..., 0].max()
    assert (far > near).all() and unit.std() > 0.01
    wall = np.full((32, 32, 3), 7.0, np.float32)
    kept = [(smoke.veiled(wall, np.full((32, 32), z, np.float32), 0.45, eye, *grid) - veil) / 7
            for z, veil in ((40.0, near), (80.0, far))]  # fmt: skip
    assert np.allclose(kept[0] ** 2, kept[1], rtol=1e-3) and (kept[1] < 1).all()


def test_blood_is_dark_red_and_glossy(scenes, pictures):
    texture, plain = scenes["blood"].texture, scenes["bowel"].texture
    bloody = texture[..., 0] < 0.6 * plain[..., 0]
    assert 0.10 < bloody.mean() < 0.45
    red, green = texture[bloody][:, 0], texture[bloody][:, 1]
    assert np.median(red / green) > 5  # tissue: about 4
    assert texture[bloody][:, 5].mean() > 1.2 > plain[bloody][:, 5].mean()
    clean = ~bloody & (texture[..., 0] == plain[..., 0])
    assert clean.mean() > 0.4 and np.array_equal(texture[clean][:, 1:3], plain[clean][:, 1:3])
    assert (pictures["blood"][..., 0] < 110).mean() > (pictures["bowel"][..., 0] < 110).mean()


def test_no_blood_changes_nothing():
    rng = np.random.default_rng(0)
    albedo = rng.uniform(0.1, 0.9, (4, 5, 3)).astype(np.float32)
    relief, wet = rng.normal(size=(4, 5)), rng.uniform(0.3, 1, (4, 5))
    color, smooth, gloss = bled(albedo, relief, wet, np.zeros((4, 5), np.float32))
    assert np.array_equal(color, albedo) and np.array_equal(smooth, relief) and np.array_equal(gloss, wet)


def test_a_liver_is_liver_everywhere(scenes):
    # Elsewhere only a part of the tissue is: the texture's detail is that of lobules, without vessels.
    anatomy = build_anatomy(SMALL.seed)
    a, b = np.meshgrid(np.linspace(-30, 30, 40), np.linspace(-20, 20, 30))
    assert (organs_at(anatomy, a, b).owner >= 0).mean() > 0.5
    hue = {kind: scenes[kind].texture[..., 1] / scenes[kind].texture[..., 0] for kind in ("bowel", "liver")}
    assert hue["liver"].std() < 0.02 < 0.05 < hue["bowel"].std()


# --- smoke and gain beside the kind of tissue ------------------------------------------------------------------------


def test_smoke_option_veils_images_and_leaves_the_truth_clear():
    plain, smoky = (build_scene(replace(SMALL, smoke=share)) for share in (0.0, 0.66))
    before, after = (render_view(scene, SceneState.of(scene, 0.45), AT_ORIGIN) for scene in (plain, smoky))
    assert np.array_equal(before.tissue, after.tissue)
    assert np.abs(before.image - after.image).mean() > 0.05
    kind = build_scene(replace(SMALL, tissue="smoke"))
    assert np.array_equal(render_view(kind, SceneState.of(kind, 0.45), AT_ORIGIN).image, after.image)


def test_automatic_gain_follows_brightness_with_a_lag():
    gains = [1.0]
    for measured in [0.2] * 3 + [0.4] * 40:
        gains.append(next_gain(gains[-1], measured, 0.2))
    assert gains[3] == 1 and 0.5 < gains[5] < 0.9 and gains[-1] == pytest.approx(0.5, rel=1e-3)
    image = np.zeros((9, 9, 3), np.float32)
    image[4, 4] = 1
    corner = np.roll(image, 4, (0, 1))
    assert metered(image) > 10 * metered(corner)


def test_the_folder_has_the_true_gains(tmp_path):
    write_phantom(tmp_path / "auto", replace(SMALL, frames=6, gain="auto", smoke=0.5, side_views=False))
    write_phantom(tmp_path / "plain", replace(SMALL, frames=6, side_views=False))
    described = json.loads((tmp_path / "auto/truth/scene.json").read_text())
    assert len(described["gain"]) == len(described["smoke"]) == 6 and described["gain"][0] == 1 != described["gain"][-1]
    for index in range(6):
        one, other = ((tmp_path / name / f"truth/tissue/{index:06d}.png").read_bytes() for name in ("auto", "plain"))
        assert one == other
