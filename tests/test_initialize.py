"""Sampling of initial points and their back-projection."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.stats import chisquare

from endoprior.core.checks import InputError
from endoprior.core.config import InitConfig, ReleasedMethod
from endoprior.core.geometry import project
from endoprior.core.types import Camera, Frame
from endoprior.data import load_sequence
from endoprior.initialization import sampling
from endoprior.initialization.sampling import (
    PointCloud,
    eroded_mask,
    initial_log_scales,
    initial_points,
    merge_voxels,
    pixel_probability,
    quotas,
    remove_outliers,
    sample_pixels,
    sampling_distribution,
)
from endoprior.model.presets import preset
from endoprior.priors import joint_texture_prior

HEIGHT, WIDTH = 26, 32


@pytest.fixture
def rho() -> np.ndarray:
    return np.random.default_rng(1).random((HEIGHT, WIDTH), dtype=np.float32)


@pytest.fixture
def mask() -> np.ndarray:
    """Tissue but for a tool in the lower right corner."""
    tissue = np.ones((HEIGHT, WIDTH), bool)
    tissue[14:, 20:] = False
    return tissue


def tilted_camera() -> Camera:
    """A camera that is neither at the origin nor parallel to its axes."""
    c, s = math.cos(0.4), math.sin(0.4)
    rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, (5, -8, 12)
    return Camera(WIDTH, HEIGHT, 30.0, 31.0, 15.0, 14.0, world_to_camera)


def make_frame(mask: np.ndarray, index: int = 0, camera: Camera | None = None) -> Frame:
    """A frame of random colors whose depth is known except in two rows."""
    rng = np.random.default_rng(100 + index)
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[4:6] = False
    depth = np.where(valid, 50 + 10 * rng.random((HEIGHT, WIDTH)), 0).astype(np.float32)
    rgb = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return Frame(index, index / 10, camera or tilted_camera(), rgb, mask, depth, valid)


def pixels_of(cloud: PointCloud, camera: Camera) -> np.ndarray:
    """(N, 2) image coordinates of the points."""
    return project(cloud.points.astype(np.float64), camera)[0]


# --- Eq. (6)


def erosion_loop(mask: np.ndarray, element: np.ndarray) -> np.ndarray:
    """Minimum over the element; pixels outside the image do not count."""
    half = element.shape[0] // 2
    out = np.zeros_like(mask)
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            lowest = True
            for dv in range(-half, half + 1):
                for du in range(-half, half + 1):
                    y, x = v + dv, u + du
                    inside = 0 <= y < mask.shape[0] and 0 <= x < mask.shape[1]
                    if element[dv + half, du + half] and inside:
                        lowest = lowest and bool(mask[y, x])
            out[v, u] = lowest
    return out


@pytest.mark.parametrize("size", [3, 5, 9])
def test_erosion_matches_loop(mask, size):
    mask[3, 3] = False
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    np.testing.assert_array_equal(eroded_mask(mask, size), erosion_loop(mask, element))


def test_erosion_falls_back_and_can_be_off(mask):
    assert eroded_mask(mask, 1) is mask
    speck = np.zeros_like(mask)
    speck[3, 3] = True
    np.testing.assert_array_equal(eroded_mask(speck, 9), speck)


def test_distribution_matches_loop(rho, mask):
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
    eroded = erosion_loop(mask, element)
    inside = [(v, u) for v in range(HEIGHT) for u in range(WIDTH) if eroded[v, u]]
    total = sum(float(rho[p]) for p in inside)
    want = np.zeros((HEIGHT, WIDTH))
    for p in inside:
        want[p] = 0.45 / (len(inside) + 1e-6) + 0.55 * float(rho[p]) / (total + 1e-6)
    # normalizing removes the epsilons: 1e-6 in sums of several hundred
    np.testing.assert_allclose(sampling_distribution(rho, mask), want, rtol=1e-8)


@pytest.mark.parametrize("eta", [0.0, 0.45, 1.0])
def test_distribution_sums_to_one_inside_the_eroded_mask(rho, mask, eta):
    probability = sampling_distribution(rho, mask, eta)
    assert probability.dtype == np.float64
    assert probability.sum() == pytest.approx(1, abs=1e-12)  # float64, 800 terms
    assert not probability[~eroded_mask(mask, 9)].any() and probability.min() >= 0


@pytest.mark.parametrize("eta", [0.0, 0.45])
def test_no_texture_gives_uniform_sampling(mask, eta):
    probability = sampling_distribution(np.zeros((HEIGHT, WIDTH)), mask, eta)
    inside = probability[eroded_mask(mask, 9)]
    np.testing.assert_allclose(inside, 1 / len(inside), rtol=1e-12)


def test_no_tissue_gives_nothing(rho, mask):
    assert not sampling_distribution(rho, np.zeros_like(mask)).any()


def test_invalid_prior_is_named(rho, mask):
    for value in (np.nan, -0.1, np.inf):
        rho[2, 2] = value
        with pytest.raises(ValueError, match="rho must be finite and >= 0"):
            sampling_distribution(rho, mask)
    with pytest.raises(ValueError, match="tissue_mask must have shape"):
        sampling_distribution(rho, mask[1:])


# --- drawing


def test_single_samples_follow_the_distribution(rho, mask, monkeypatch):
    monkeypatch.setattr(sampling, "EROSION_PX", 5)
    probability = sampling_distribution(rho[:12, :16], mask[:12, :16])
    rng = np.random.default_rng(7)
    draws = 50_000
    drawn = np.bincount(
        [sample_pixels(probability, 1, rng)[0] for _ in range(draws)], minlength=probability.size
    ).reshape(probability.shape)
    possible = probability > 0
    assert not drawn[~possible].any()
    # a correct sampler fails one time in 10,000, and the seed is fixed
    assert chisquare(drawn[possible], draws * probability[possible]).pvalue > 1e-4


@pytest.mark.slow
def test_a_million_samples_without_replacement_follow_the_distribution(rho, mask, monkeypatch):
    # Tiled 1,250 times, each pixel is so rare that drawing 2 % of the field leaves the odds as they were.
    monkeypatch.setattr(sampling, "EROSION_PX", 5)
    probability = sampling_distribution(rho[:12, :16], mask[:12, :16])
    tiles = 1250
    field = np.tile(probability.reshape(1, -1), (tiles, 1))
    rng = np.random.default_rng(8)
    drawn = np.zeros(probability.size)
    for _ in range(200):
        flat = sample_pixels(field, 5000, rng)
        assert len(np.unique(flat)) == 5000
        drawn += np.bincount(flat % probability.size, minlength=probability.size)
    expected = 1_000_000 * probability.ravel()
    # counting noise of 1 / sqrt(2,300) for the rarest pixel, 4 of which the worst of 192 may reach; depletion adds 1 %
    np.testing.assert_allclose(drawn, expected, rtol=0.1, atol=0)


def test_pairs_are_sampled_sequentially():
    weights = np.array([[1.0, 2.0, 3.0]])
    rng = np.random.default_rng(9)
    draws = 20_000
    pairs = np.array([sample_pixels(weights, 2, rng) for _ in range(draws)])
    # P{1,2} = 2/6 * 3/4 + 3/6 * 2/3
    share = (pairs == [1, 2]).all(1).mean()
    assert share == pytest.approx(2 / 6 * 3 / 4 + 3 / 6 * 2 / 3, abs=4 * 0.5 / math.sqrt(draws))  # 4 standard errors


def test_sampling_returns_all_pixels_if_there_are_too_few():
    weights = np.array([[0, 0.5, 0, 1e-300]])
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(sample_pixels(weights, 10, rng), [1, 3])
    assert len(sample_pixels(weights, 0, rng)) == 0
    assert len(sample_pixels(np.zeros((2, 2)), 3, rng)) == 0


@pytest.mark.parametrize(("budget", "frames"), [(20_000, 55), (20_000, 136), (3, 5), (7, 1), (10, 5)])
def test_quotas_sum_to_the_budget(budget, frames):
    shares = quotas(budget, frames)
    assert sum(shares) == budget and len(shares) == frames and max(shares) - min(shares) <= 1
    assert shares == sorted(shares, reverse=True)


def test_published_shares():
    assert set(quotas(20_000, 55)) == {363, 364} and set(quotas(20_000, 136)) == {147, 148}


# --- the cloud


@pytest.mark.parametrize("sampler", ["prior", "uniform", "pool"])
def test_points_project_onto_centers_of_measured_tissue(mask, sampler, monkeypatch):
    monkeypatch.setattr(sampling, "POOL_FRACTION", 0.3)
    frame = make_frame(mask)
    cloud = initial_points([frame], InitConfig(sampler=sampler, budget=150))
    assert len(cloud) == 150 and cloud.points.dtype == cloud.colors.dtype == np.float32
    pixels = pixels_of(cloud, frame.camera)
    corner = pixels - 0.5
    u, v = np.rint(corner).astype(int).T
    # float32 points at 60 mm: 4e-6 mm, half a pixel per mm
    np.testing.assert_allclose(corner, np.stack([u, v], -1), atol=2e-5)
    assert frame.tissue_mask[v, u].all() and frame.depth_valid[v, u].all()
    np.testing.assert_array_equal(cloud.colors, frame.rgb[v, u])
    z = project(cloud.points.astype(np.float64), frame.camera)[1]
    np.testing.assert_allclose(z, frame.depth[v, u], rtol=1e-6)  # float32
    distinct = len(np.unique(v * WIDTH + u))
    if sampler == "pool":
        assert distinct < 150  # with replacement
    else:
        assert distinct == 150
        inside = eroded_mask(mask, 9)[v, u]
        assert inside.all() if sampler == "prior" else not inside.all()


def test_legacy_offset_is_half_a_pixel_up_left(mask):
    frame = make_frame(mask)
    exact, legacy = (
        initial_points([frame], InitConfig(budget=80), ReleasedMethod(half_pixel_shift=shifted))
        for shifted in (False, True)
    )
    shift = pixels_of(legacy, frame.camera) - pixels_of(exact, frame.camera)
    np.testing.assert_allclose(shift, -0.5, atol=2e-5)  # float32 points, as above


@pytest.mark.parametrize(("name", "offset"), [("default", 0.5), ("paper", 0.5), ("released", 0), ("endogaussian", 0)])
def test_pixels_that_presets_back_project(mask, name, offset):
    """The programs of EndoGaussian and EndoPrior-GS take integer pixels; the equations say nothing."""
    cfg, frame = preset(name, **{"init.budget": 80, "released.cleanup": False}), make_frame(mask)
    pixels = pixels_of(initial_points([frame], cfg.init, cfg.released), frame.camera)
    np.testing.assert_allclose(pixels - np.floor(pixels + 1e-3), offset, atol=2e-5)  # float32 points, as above


def test_seed_decides(mask):
    frames = [make_frame(mask, i) for i in range(3)]
    cfg = InitConfig(budget=100)
    first, again, other = (initial_points(frames, cfg, seed=s) for s in (5, 5, 6))
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.colors, again.colors)
    assert not np.array_equal(first.points, other.points)


def test_every_frame_contributes_its_share(mask):
    frames = [make_frame(mask, i) for i in range(3)]
    cloud = initial_points(frames, InitConfig(budget=101, sampler="uniform"))
    colors = [{tuple(c) for c in frame.rgb.reshape(-1, 3)} for frame in frames]
    assert [sum(tuple(c) in known for c in cloud.colors) for known in colors] == [34, 34, 33]


def test_pool_keeps_a_share_of_each_frame(mask, monkeypatch):
    monkeypatch.setattr(sampling, "POOL_FRACTION", 0.05)
    frames = [make_frame(mask, i) for i in range(4)]
    cloud = initial_points(frames, InitConfig(budget=5000, sampler="pool"))
    usable = int((mask & frames[0].depth_valid).sum())
    # 5,000 draws from 4 x 30 points miss none of them
    assert len(cloud) == 5000 and len(np.unique(cloud.points, axis=0)) == 4 * int(0.05 * usable)


def test_pool_of_a_tiny_share_still_has_a_point_of_each_frame(mask, monkeypatch):
    monkeypatch.setattr(sampling, "POOL_FRACTION", 0)
    frames = [make_frame(mask, i) for i in range(4)]
    cloud = initial_points(frames, InitConfig(budget=200, sampler="pool"))
    assert len(np.unique(cloud.points, axis=0)) == 4


def test_a_frame_with_too_few_pixels_logs_a_warning(mask, caplog):
    small = np.zeros_like(mask)
    small[10, 3:8] = True
    frames = [make_frame(mask, 0), make_frame(small, 1), make_frame(np.zeros_like(mask), 2)]
    with caplog.at_level(logging.WARNING):
        cloud = initial_points(frames, InitConfig(budget=90))
    assert len(cloud) == 30 + 5
    assert [record.getMessage() for record in caplog.records] == [
        "initialization: 55 of 90 points are missing, too few tissue pixels"
    ]


@pytest.mark.parametrize("sampler", ["prior", "uniform", "pool"])
@pytest.mark.parametrize("frames", ["none", "tool", "no depth"])
def test_nothing_to_sample_is_bad_input(mask, sampler, frames, caplog):
    frame = make_frame(mask)
    given = {
        "none": [],
        "tool": [replace(frame, tissue_mask=np.zeros_like(mask))],
        "no depth": [replace(frame, depth_valid=np.zeros_like(mask))],
    }[frames]
    with pytest.raises(InputError, match="initialization: expected at least 4 tissue pixels with depth") as caught:
        initial_points(given, InitConfig(sampler=sampler))
    assert "\n" not in str(caught.value) and caplog.text.count("\n") <= 1


def test_released_prior_raises_its_threshold_and_takes_the_eroded_mask(mask):
    frame = make_frame(mask)
    frame = replace(frame, rgb_u8=(frame.rgb_u8 // 2 + 120))  # bright: the 97th percentile exceeds 0.85
    eroded = eroded_mask(mask, 9)
    bright = float(np.percentile(frame.rgb.max(-1)[eroded], 97))
    assert bright > 0.86
    results = []
    for released, rho in (
        (False, joint_texture_prior(frame.rgb, mask)),
        (True, joint_texture_prior(frame.rgb, eroded, value_threshold=bright)),
    ):
        results.append(np.where(frame.depth_valid, sampling_distribution(rho, mask), 0))
        np.testing.assert_array_equal(pixel_probability(frame, InitConfig(), released), results[-1])
    assert not np.allclose(*results)


def test_adaptive_threshold_never_falls(mask):
    frame = make_frame(mask)
    dim = replace(frame, rgb_u8=frame.rgb_u8 // 4)
    rho = joint_texture_prior(dim.rgb, eroded_mask(mask, 9))
    want = np.where(frame.depth_valid, sampling_distribution(rho, mask), 0)
    np.testing.assert_array_equal(pixel_probability(dim, InitConfig(), True), want)


def test_texture_attracts_points():
    frame = make_frame(np.ones((HEIGHT, WIDTH), bool))
    rgb = frame.rgb_u8.copy() // 2
    rgb[:, : WIDTH // 2] = 90
    frame = replace(frame, rgb_u8=rgb, depth_valid=np.ones((HEIGHT, WIDTH), bool), depth=np.full_like(frame.depth, 60))
    cloud = initial_points([frame], InitConfig(budget=100))
    left = (pixels_of(cloud, frame.camera)[:, 0] < WIDTH // 2 - 1).mean()
    assert left == pytest.approx(0.45 / 2, abs=0.1)  # only the even share; binomial, 100 draws: sd 0.04


def test_clean_up_merges_and_removes(mask, monkeypatch):
    monkeypatch.setattr(sampling, "VOXEL_DIVISIONS", 20)
    frames = [make_frame(mask, i) for i in range(3)]
    plain = InitConfig(budget=600)
    cloud = initial_points(frames, plain, ReleasedMethod(cleanup=True))
    want = remove_outliers(merge_voxels(initial_points(frames, plain), 20), 20, 1.5)
    np.testing.assert_array_equal(cloud.points, want.points)
    assert 4 < len(cloud) < 600


# --- on files


def test_tiny_sequence_gives_the_budget_on_the_plane(tiny_sequence):
    seq = load_sequence(tiny_sequence)
    cloud = initial_points(seq.frames("train"), InitConfig(budget=1000))
    assert len(cloud) == 1000
    x, y, z = cloud.points.T.astype(np.float64)
    # the fixture's plane z = z0 + 0.1 x + 0.15 y with z0 in 58..62; 0.5 mm for clipping at the percentiles
    assert (np.abs(z - 0.1 * x - 0.15 * y - 60) < 2.5).all()


def test_test_frames_are_never_read(tiny_sequence):
    frames = load_sequence(tiny_sequence).frames("train")
    want = initial_points(frames, InitConfig(budget=300))
    for i in (1, 9):
        (tiny_sequence / f"images/{i:06d}.png").write_bytes(b"")
    got = initial_points(load_sequence(tiny_sequence).frames("train"), InitConfig(budget=300))
    np.testing.assert_array_equal(got.points, want.points)


def test_real_clip(real_clip):
    frames = load_sequence(real_clip).frames("train")[:6]
    cloud = initial_points(frames, InitConfig(budget=2000), ReleasedMethod(cleanup=True))
    assert 1500 < len(cloud) < 2000
    spacing = np.exp(initial_log_scales(cloud.points))
    assert 0.2 < np.median(spacing) < 10  # mm, a field of about 130 x 110 mm
