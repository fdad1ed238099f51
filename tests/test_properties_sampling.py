"""Initial points, their clean-up and their motion on generated clips: budgets, masks, refusals, no test frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from frame_strategies import SEEDS, clips
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis_profiles import examples

from endoprior.core.checks import InputError
from endoprior.core.config import InitConfig, ReleasedMethod
from endoprior.core.config_deformation import BasisConfig
from endoprior.core.geometry import project
from endoprior.core.types import Camera, Frame
from endoprior.data.pixels import shrunk
from endoprior.data.sequence import FrameSequence
from endoprior.initialization.flow_tracks import initial_motion
from endoprior.initialization.sampling import (
    PointCloud,
    initial_log_scales,
    initial_points,
    merge_voxels,
    pixel_probability,
    quotas,
    remove_outliers,
    sample_pixels,
)
from endoprior.model.presets import preset
from endoprior.training.gaussian_trainer import GaussianTrainer


@st.composite
def configs(draw):
    return InitConfig(
        sampler=draw(st.sampled_from(["prior", "uniform", "pool"])),
        budget=draw(st.integers(1, 400)),
    )


RELEASED = st.builds(ReleasedMethod, prior=st.booleans(), cleanup=st.booleans(), half_pixel_shift=st.booleans())


def most_points(usable, cfg):
    """Points that usable pixels (H, W) bool, one array a frame, can give without clean-up."""
    if cfg.sampler == "pool":
        return cfg.budget if any(mask.any() for mask in usable) else 0
    return sum(min(int(mask.sum()), share) for mask, share in zip(usable, quotas(cfg.budget, len(usable)), strict=True))


def usable_pixels(clip, cfg, released):
    """(H, W) bool of each frame."""
    return [pixel_probability(frame, cfg, released.prior) > 0 for frame in clip]


@given(clips(), configs(), RELEASED, SEEDS)
def test_a_clip_gives_its_budget_of_finite_points_or_one_line(clip, cfg, released, seed):
    most = most_points(usable_pixels(clip, cfg, released), cfg)
    try:
        cloud = initial_points(clip, cfg, released, seed)
    except InputError as refusal:
        message = str(refusal)
        assert message.startswith("initialization: expected at least 4 tissue pixels with depth")
        assert "\n" not in message and (released.cleanup or most < 4)
        return
    assert 4 <= len(cloud) <= most <= cfg.budget and (released.cleanup or len(cloud) == most)
    assert cloud.points.dtype == np.float32 and np.isfinite(cloud.points).all()
    assert (cloud.colors >= 0).all() and (cloud.colors <= 1).all()
    assert np.isfinite(initial_log_scales(cloud.points)).all()
    again = initial_points(clip, cfg, released, seed)
    assert all(np.array_equal(getattr(cloud, name), getattr(again, name)) for name in ("points", "colors", "origins"))


@given(clips(), configs(), RELEASED, SEEDS)
def test_points_lie_on_usable_pixels_of_their_own_frame(clip, cfg, released, seed):
    released, usable = replace(released, cleanup=False), usable_pixels(clip, cfg, released)
    assume(most_points(usable, cfg) >= 4)
    cloud = initial_points(clip, cfg, released, seed)
    shares, offset = quotas(cfg.budget, len(clip)), 0.5 if released.half_pixel_shift else 0.0
    for position, frame in enumerate(clip):
        own = cloud.origins == position
        if cfg.sampler != "pool":
            assert own.sum() == min(shares[position], usable[position].sum())
        pixels, z = project(cloud.points[own].astype(np.float64), frame.camera)
        near = z < 1e4  # float32 coordinates of farther points do not tell pixels apart
        x, y = np.floor(pixels[near] + offset + 1e-3 * (offset > 0)).astype(int).T  # integers round to either side
        assert (z > 0.19).all() and usable[position][y, x].all()


@pytest.mark.parametrize("depth", [0.06, 0.2, 1e-30, 1e9, 1e30])
@pytest.mark.parametrize("sampler", ["prior", "uniform", "pool"])
def test_depth_outside_the_renderable_range_is_one_error_line(depth, sampler, caplog):
    """Meters that pass for millimeters lie in front of the near plane: training would never show anything."""
    camera, z = Camera(30, 20, 50.0, 50.0, 15.0, 10.0, np.eye(4)), np.full((20, 30), depth, np.float32)
    frame = Frame(0, 0.0, camera, np.full((20, 30, 3), 90, np.uint8), np.ones((20, 30), bool), z, z > 0)
    with pytest.raises(InputError, match=r"between 0\.2 and 1e\+06 mm .*, got 0\. Fix: Check masks, depth"):
        initial_points([frame] * 3, InitConfig(sampler=sampler, budget=100))
    assert not caplog.records  # the error is one line, without a warning before it


@given(st.integers(0, 500), st.integers(0, 30))
def test_quotas_are_equal_shares_of_the_whole_budget(budget, num_frames):
    shares = quotas(budget, num_frames)
    assert sum(shares) == (budget if num_frames else 0)
    assert not shares or max(shares) - min(shares) <= 1


@given(SEEDS, st.integers(1, 30), st.integers(1, 30), st.integers(0, 1000), st.sampled_from([0.0, -300.0, 300.0]))
def test_sampled_pixels_are_distinct_and_have_weight(seed, height, width, count, exponent):
    rng = np.random.default_rng(seed)
    weights = np.where(rng.random((height, width)) < 0.6, rng.random((height, width)) * 10.0**exponent, 0)
    drawn = sample_pixels(weights, count, rng)
    assert len(drawn) == min(count, np.count_nonzero(weights))
    assert (np.diff(drawn) > 0).all() and (weights.reshape(-1)[drawn] > 0).all()


@given(SEEDS, st.integers(0, 60), st.sampled_from([0.0, 1e-30, 1.0, 1e8]), st.integers(1, 400))
def test_clean_up_keeps_finite_points_inside_the_box(seed, num, size, divisions):
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(num, 3)) * size).astype(np.float32)
    cloud = PointCloud(points, rng.random((num, 3)).astype(np.float32), np.zeros(num, np.int32))
    merged = merge_voxels(cloud, divisions)
    kept = remove_outliers(merged, 20, 1.5)
    assert len(kept) <= len(merged) <= num and bool(len(merged)) == bool(num) == bool(len(kept))
    for found in (merged, kept):
        assert np.isfinite(found.points).all() and np.isfinite(found.colors).all()
        if len(found):
            slack = 1e-6 * np.abs(points).max()
            assert (found.points >= points.min(0) - slack).all() and (found.points <= points.max(0) + slack).all()


@given(clips(most=3), st.integers(1, 5))
def test_shrunk_frames_keep_their_meaning(clip, factor):
    for frame in clip:
        small = shrunk(frame, factor)
        height, width = small.tissue_mask.shape
        assert (small.camera.width, small.camera.height) == (width, height)
        assert width == max(frame.camera.width // factor, 1) and height == max(frame.camera.height // factor, 1)
        assert small.rgb_u8.shape == (height, width, 3) and small.depth.shape == (height, width)
        assert np.isfinite(small.depth).all() and (small.depth[~small.depth_valid] == 0).all()
        assert small.tissue_mask.sum() <= frame.tissue_mask.sum()
        if (
            frame.camera.width < factor or frame.camera.width % factor == 0
        ):  # nothing was cut off: the same field of view
            assert (width - small.camera.cx) / small.camera.fx == pytest.approx(
                (frame.camera.width - frame.camera.cx) / frame.camera.fx
            )


@examples(15)
@given(st.integers(1, 3), st.integers(20, 70), st.integers(20, 70), SEEDS, st.sampled_from(["still", "noise", "black"]))
def test_initial_motion_is_finite_for_any_images(count, height, width, seed, kind):
    rng = np.random.default_rng(seed)
    camera = Camera(width, height, 60.0, 60.0, width / 2, height / 2, np.eye(4))
    still = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    found = []
    for i in range(count):
        picture = {"still": still, "noise": rng.integers(0, 256, still.shape).astype(np.uint8), "black": 0 * still}[
            kind
        ]
        depth = rng.uniform(30, 60, (height, width)).astype(np.float32)
        depth[rng.random((height, width)) < 0.3] = rng.choice([0.0, 1e-4, 1e20, 3e38])
        mask = rng.random((height, width)) < 0.8
        found.append(Frame(i, i / count, camera, picture, mask, depth, depth > 0))
    cloud = initial_points(found, InitConfig(budget=50), seed=seed)
    motion = initial_motion(found, cloud, BasisConfig(num_bases=5)).coefficients
    assert motion.shape == (len(cloud), 5, 3) and np.isfinite(motion).all()
    assert kind != "still" or count > 1 or (motion == 0).all()


@pytest.mark.parametrize("count", [2, 3, 9, 10, 18])
def test_initialization_reads_no_test_frame(count):
    rng = np.random.default_rng(0)
    camera = Camera(40, 36, 50.0, 50.0, 20.0, 18.0, np.eye(4))

    def read(index):
        assert (index - 1) % 8 != 0, f"test frame {index} was read"
        picture = rng.integers(0, 256, (36, 40, 3)).astype(np.uint8)
        depth = np.full((36, 40), 50, np.float32)
        return Frame(index, index / count, camera, picture, np.ones((36, 40), bool), depth, depth > 0)

    cfg = preset("default")
    trainer = GaussianTrainer(
        FrameSequence(Path("made"), [camera] * count, read), replace(cfg, init=replace(cfg.init, budget=60))
    )
    trainer.start()
    for _ in range(3):
        trainer.step()
