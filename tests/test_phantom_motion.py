"""Motion of the phantom, up to a strong pull and tissue that slides out of the image; smooth patches."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.phantom.motion import build_motion, smooth_step
from endoprior.phantom.raster import FAR, rasterize
from endoprior.phantom.scene import build_scene
from endoprior.phantom.surface import build_anatomy, build_plane
from endoprior.phantom.texture import smooth_patches

STRONG = PhantomConfig(frames=12, width=96, height=80, seed=3, pull_mm=30, slide_mm=12, smooth_share=0.3)


@pytest.fixture(scope="module")
def strong(tmp_path_factory):
    """A small phantom with a strong pull, which slides and has smooth patches."""
    out = tmp_path_factory.mktemp("phantom") / "strong"
    write_phantom(out, STRONG)
    return out


def test_points_leave_the_image_and_return(strong):
    tracks = np.load(strong / "truth/tracks.npz")
    p, visible = tracks["points"].astype(float), tracks["visible"]
    x = 0.9 * 96 * p[..., 0] / p[..., 2] + 48
    left_after_seen = np.logical_or.accumulate(visible, 0) & ((x < 0) | (x > 96))
    returned = (np.logical_or.accumulate(left_after_seen, 0) & visible).any(0)
    assert returned.sum() > 15
    assert np.linalg.norm(p - p[:1], axis=-1).max() > 0.85 * STRONG.pull_mm


def test_regions_say_what_is_pulled_and_what_is_smooth(strong):
    tracks = np.load(strong / "truth/tracks.npz")
    points, region = tracks["points"], tracks["region"]
    assert set(region) == {"pulled", "smooth", "spread"} and region.shape == (256,)
    assert min((region == name).sum() for name in ("pulled", "smooth", "spread")) > 20
    moved = np.linalg.norm(points - points[:1], axis=-1).max(0)
    assert np.median(moved[region == "pulled"]) > 15 > np.median(moved[region != "pulled"])


@pytest.mark.parametrize("seed", [1, 8])
def test_tissue_covers_the_image_whatever_moves_it(seed, monkeypatch):
    monkeypatch.setattr("endoprior.phantom.scene.build_texture", lambda *_: None)
    cfg = PhantomConfig(
        seed=seed, width=64, height=52, pull_mm=30, slide_mm=7.7, breathing_mm=8, focal_per_width=1.4, principal_x=41
    )
    scene = build_scene(cfg)
    for phase in (0.25, 0.55, 0.75):
        assert rasterize(scene.vertices(phase), cfg.focal, cfg.center, 64, 52)[..., 2].max() < FAR


def test_smooth_patches_cover_their_share_and_have_little_texture():
    b, a = np.mgrid[-50:50:0.5, -60:60:0.5]
    patches = smooth_patches(a, b, 3, 0.3)
    assert (patches > 0.5).mean() == pytest.approx(0.3, abs=0.04) and 0 <= patches.min() and patches.max() == 1
    assert (np.abs(np.diff(patches, axis=1)) < 0.25).all(), "blended, without an edge"
    usual, smooth = (build_scene(replace(STRONG, smooth_share=share)).texture for share in (0.0, 0.3))
    rows, columns = (np.arange(n) + 0.5 for n in usual.shape[:2])
    grid_v, grid_u = np.meshgrid(rows / len(rows), columns / len(columns), indexing="ij")
    patches = smooth_patches(*build_plane(STRONG).coordinates(grid_u, grid_v), STRONG.seed, 0.3)

    def detail(texture, where):
        green = texture[..., 1]
        return np.abs(green - cv2.GaussianBlur(green, (0, 0), 3))[where].mean()

    assert detail(smooth, patches > 0.99) < 0.2 * detail(usual, patches > 0.99)
    assert np.array_equal(smooth[patches == 0][:, :3], usual[patches == 0][:, :3])


@pytest.mark.parametrize("change", [{"pull_mm": 15}, {"pull_mm": 30, "slide_mm": 12}], ids=["usual", "strong"])
@pytest.mark.parametrize("seed", range(6))
def test_motion_never_folds_the_tissue(seed, change):
    cfg = PhantomConfig(seed=seed, breathing_mm=8, **change)
    motion = build_motion(cfg, build_plane(cfg), build_anatomy(seed))
    b, a = np.mgrid[-60:60:1.0, -70:70:1.0]
    for phase in (0.0, 0.25, 0.4, 0.55, 0.7):
        moved = motion.displacement(a, b, phase)
        (ab, aa), (bb, ba) = np.gradient(a + moved[..., 0]), np.gradient(b + moved[..., 1])
        assert (aa * bb - ab * ba).min() > 0.02  # area ratio of the map (a, b) -> moved (a, b); 1 is undeformed


@pytest.mark.parametrize("change", [{}, {"pull_mm": 30, "slide_mm": 12}], ids=["usual", "strong"])
def test_motion_and_tools_are_smooth(change):
    cfg = PhantomConfig(frames=96, **change)  # two cycles, so that the hand-over between them is covered
    motion = build_motion(cfg, build_plane(cfg), build_anatomy(0))
    steps = 2000
    phases = np.linspace(0, 1, steps)
    center = motion.pulls[0].center
    tissue = np.array([motion.displacement(*np.float64(center).reshape(2, 1), p)[0] for p in phases])
    tips = np.array([motion.tools(p)[0].tip for p in phases])
    hover = np.array([motion.tools(p)[1].tip for p in phases])
    for path in (tissue, tips, hover):
        velocity = np.diff(path, axis=0) * steps
        # A jump in velocity would show at full size however fine the steps; smooth motion changes it by O(1 / steps).
        assert np.abs(np.diff(velocity, axis=0)).max() < 0.03 * max(np.abs(velocity).max(), 1)


@pytest.mark.parametrize("change", [{}, {"pull_mm": 30, "slide_mm": 12}], ids=["usual", "strong"])
def test_the_grasper_holds_what_it_pulls(change):
    cfg = PhantomConfig(seed=1, **change)
    motion = build_motion(cfg, build_plane(cfg), build_anatomy(1))
    pull = motion.pulls[0]
    for phase in (0.3, 0.5, 0.6):
        assert np.allclose(motion.tools(phase)[0].tip, motion.held(pull, phase), atol=1e-9)
        assert motion.tools(phase)[0].opening < 0.1
    assert motion.tools(0.0)[0].opening > 0.5
    dragged = motion.held(pull, 0.55) - motion.held(pull, 0.0)
    assert np.linalg.norm(dragged) > 0.7 * cfg.pull_mm and pull.strength(0.0) == 0 and pull.strength(1.0) == 0


def test_smooth_step_closed_form():
    assert [smooth_step(1, 3, x) for x in (0, 1, 2, 3, 4)] == [0, 0, 0.5, 1, 1]
