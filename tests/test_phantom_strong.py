"""The phantom with a strong pull, which slides out of the image and has smooth patches."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.phantom.generate import build_scene
from endoprior.phantom.raster import FAR, rasterize
from endoprior.phantom.surface import build_plane
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
def test_tissue_covers_the_image_whatever_moves_it(seed):
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
