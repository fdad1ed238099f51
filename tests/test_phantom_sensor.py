"""The phantom's sensor: stereo errors of depth, glints, tone curve and noise, in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from endoprior.phantom import PhantomConfig
from endoprior.phantom.sensor import develop, expose, stereo_depth


def test_stereo_error_on_a_wall_closed_form():
    cfg = PhantomConfig(depth_noise_px=0.16)
    z = np.full((200, 640), 75, np.float32)
    depth = stereo_depth(z, np.zeros((200, 640, 3), np.uint8), cfg, np.random.default_rng(0))
    assert (depth > 0).all()
    # sigma_z = z^2 / (f b) * sigma_d, plus the 1/16 px steps (1/sqrt(12) of a step); 15 % for the finite sample
    want = 75**2 / (cfg.focal * cfg.baseline_mm) * np.hypot(0.16, 1 / 16 / np.sqrt(12))
    assert depth.std() == pytest.approx(want, rel=0.15) and abs(np.median(depth) - 75) < 0.05


def test_half_occluded_strip_lies_left_of_the_near_object():
    cfg = PhantomConfig(depth_noise_px=0.0)
    z = np.full((40, 640), 100, np.float32)
    z[:, 300:400] = 50
    depth = stereo_depth(z, np.zeros((40, 640, 3), np.uint8), cfg, np.random.default_rng(0))
    gap = cfg.focal * cfg.baseline_mm * (1 / 50 - 1 / 100)  # px: how far the object shifts against the wall
    missing = depth[20] == 0
    assert missing[int(300 - gap) + 2 : 300].all() and not missing[: int(300 - gap) - 3].any()
    assert not missing[404:].any() and not missing[302:398].any()


def test_glints_have_no_depth():
    image = np.zeros((40, 640, 3), np.uint8)
    image[20, 100] = 255
    depth = stereo_depth(np.full((40, 640), 75, np.float32), image, PhantomConfig(), np.random.default_rng(0))
    assert (depth == 0).sum() == 9 and depth[20, 100] == 0


def test_tone_curve_rises_and_noise_keeps_the_level():
    ramp = np.linspace(0, 3, 300, dtype=np.float32)[None, :, None].repeat(3, -1)
    curve = develop(ramp, 1.0, np.ones((1, 300, 1), np.float32))[0, :, 0]
    assert (np.diff(curve) >= 0).all() and curve[0] == 0 and curve[-1] > 250
    flat = np.full((200, 200, 3), 127.0, np.float32)
    noisy = expose(flat, 2.0, np.random.default_rng(0)).astype(float)
    # rounding adds 1/12 to the variance; channels share part of their noise
    assert abs(noisy.mean() - 127) < 0.05 and noisy.std() == pytest.approx(2.0, rel=0.15)
    assert (expose(flat, 0.0, np.random.default_rng(0)) == 127).all()
