"""Color that changes within a Gaussian: what a pixel sees, where children of a split begin, and who does without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from export_scenes import moving_scene
from render_scenes import camera, one

from endoprior import render
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.colors import FEW_ITERATIONS, one_color
from endoprior.model.gaussians import SH_C0, attribute_shapes, with_colors
from endoprior.model.presets import preset
from endoprior.model.scene_file import load_scene
from endoprior.render.constants import BLUR_PX2
from endoprior.training.density import split_children
from endoprior.view.viewable import ViewSettings
from endoprior.view.viewable_scene import ViewableScene

BACKENDS = ["reference", "numba"]


def shown(backend, splats, view):
    """(H, W, 3) color divided by alpha, where there is any."""
    out = render.load(backend)(splats, view, background=torch.zeros(3))
    return torch.where(out.alpha[..., None] > 0.01, out.color / out.alpha[..., None].clamp(min=1e-6), torch.nan)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_disk_that_faces_the_camera_shows_the_slope_times_the_distance(backend):
    """Closed form: at d px of a Gaussian of s px, q = s d / (s^2 + blur)."""
    view = replace(camera(41, 31, seed=None), fx=50.0, fy=50.0, cx=20.5, cy=15.5)
    sigma, slopes = 4.0, torch.tensor([[[0.05, 0.0, -0.02], [0.0, 0.03, 0.01]]])
    splats = one(view, 20.5, 15.5, 60.0, scales=torch.full((1, 3), sigma * 60 / 50), color_slopes=slopes)
    found = shown(backend, splats, view)
    d = torch.arange(-5, 6) * sigma / (sigma**2 + BLUR_PX2)
    want = 0.5 + d[:, None] * slopes[0, 0] + torch.zeros(11, 3)
    assert torch.allclose(found[15, 15:26], want, atol=1e-5)
    assert torch.allclose(found[10:21, 20], 0.5 + d[:, None] * slopes[0, 1], atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_colors_turn_with_the_gaussian(backend):
    """A quarter of a turn about the axis of view turns the picture."""
    view = replace(camera(31, 31, seed=None), fx=50.0, fy=50.0, cx=15.5, cy=15.5)
    slopes = torch.tensor([[[0.05, 0.0, -0.02], [0.01, 0.03, 0.01]]])
    shape = {"scales": torch.tensor([[5.0, 2.5, 1.0]]), "color_slopes": slopes}
    before = shown(backend, one(view, 15.5, 15.5, 60.0, **shape), view)
    turned = one(view, 15.5, 15.5, 60.0, quats=torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]]), **shape)
    # From x (right) to y (down): clockwise in the picture.
    assert torch.allclose(shown(backend, turned, view), before.rot90(-1, (0, 1)), atol=1e-5, equal_nan=True)


def test_children_of_a_split_start_with_the_color_of_their_place():
    """Center and color of each child lie on the parent's line from center to slope."""
    cfg = preset("default").fitted(4)
    gaussians = create_gaussians(np.zeros((1, 3)), np.full((1, 3), 0.5), np.log([2.0]), cfg)
    slopes = torch.tensor([[[0.1, 0.0, -0.1], [0.0, 0.2, 0.0]]])
    with torch.no_grad():
        gaussians["color_slopes"].copy_(slopes)
    children = split_children(gaussians, torch.tensor([True]), 1.6, np.random.default_rng(0))
    places = children["means"][:, :2] / 2.0
    change = (children["sh_dc"] - gaussians["sh_dc"].detach())[:, 0] * SH_C0
    assert places.abs().min() > 0.01
    assert torch.allclose(change, torch.einsum("ni,ic->nc", places, slopes[0]), atol=1e-6)
    assert torch.allclose(children["color_slopes"], slopes.expand(2, -1, -1) / 1.6)


def test_numbers_shown_in_place_of_colors_have_no_slopes():
    splats = moving_scene().at(0.3)
    assert splats.color_slopes is not None and splats.color_slopes.abs().max() > 0.1
    painted = with_colors(splats, torch.full((len(splats), 3), 0.25))
    assert painted.color_slopes is None and torch.equal(painted.means, splats.means)
    view = moving_scene().cameras[0]
    out = render.load("numba")(painted, view, background=torch.zeros(3))
    assert torch.allclose(out.color, 0.25 * out.alpha[..., None].expand(-1, -1, 3), atol=1e-6)


@pytest.mark.parametrize("name", ["paper", "released", "endogaussian"])
def test_presets_of_the_papers_have_one_color_per_gaussian(name):
    assert "color_slopes" not in attribute_shapes(preset(name).fitted(8))


def test_a_scene_without_slopes_is_read_and_shown_as_before(tmp_path):
    """Files of earlier versions have no such tensor, and their config no such switch."""
    scene = moving_scene()
    cfg = replace(scene.config, render=replace(scene.config.render, color_slopes=False))
    tensors = {name: value for name, value in scene.gaussians.tensors.items() if name != "color_slopes"}
    old = replace(scene, config=cfg, gaussians=type(scene.gaussians)(tensors))
    old.save(tmp_path / "scene.safetensors")
    again = load_scene(tmp_path)
    assert again.at(0.2).color_slopes is None
    assert torch.equal(again.render(0.2).color, old.render(0.2).color)
    assert not torch.equal(again.render(0.2).color, scene.render(0.2).color)


def test_one_color_each_comes_near_the_picture():
    """The centers' colors alone are far from it; what the camera does not see is left alone."""
    scene = moving_scene(sh_degree=1)
    splats, view = scene.at(0.3), scene.cameras[3]
    hidden = replace(view, world_to_camera=np.diag([-1.0, 1.0, -1.0, 1.0]) @ view.world_to_camera)
    want = scene.render(0.3).color.clamp(0, 1)
    black = torch.zeros(3)

    def error(plain):
        assert plain.color_slopes is None and torch.equal(plain.sh[:, 1:], splats.sh[:, 1:])
        return (render.load("numba")(plain, view, background=black).color - want).square().mean()

    assert error(one_color(splats, view)) < 0.3 * error(replace(splats, color_slopes=None))
    dc = splats.sh[:, :1] * SH_C0 + 0.5
    assert torch.allclose(one_color(splats, hidden).sh[:, :1] * SH_C0 + 0.5, dc.clamp(0, 1), atol=1e-5)
    same = replace(splats, color_slopes=None)
    assert one_color(same, view) is same


def test_the_browser_gets_colors_that_show_the_picture():
    """Those of the centers are left to the view as points."""
    scene = moving_scene()
    viewable = ViewableScene(scene, "test")
    plain = one_color(scene.at(0.3), scene.cameras[3], FEW_ITERATIONS)
    found = viewable.cloud(ViewSettings(frame=3, layer="color"))
    assert np.abs(found.colors - 255 * (plain.sh[:, 0] * SH_C0 + 0.5).numpy()).max() <= 0.51
    dots = viewable.cloud(ViewSettings(frame=3, layer="color", points=True))
    centers = 255 * (scene.at(0.3).sh[:, 0] * SH_C0 + 0.5).clamp(0, 1).numpy()
    assert np.abs(dots.colors - centers).max() <= 0.51 and np.abs(found.colors - centers).max() > 5
