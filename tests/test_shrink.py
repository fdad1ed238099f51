"""Frames at a fraction of their size, and the first so many of them."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import write_tiny_sequence

from endoprior.core.config import DataConfig
from endoprior.data import load_sequence, shrunk


@pytest.mark.parametrize("factor", [2, 3])
def test_blocks_by_hand(tiny_sequence, factor):
    frame = load_sequence(tiny_sequence).frame(3)
    assert shrunk(frame, 1) is frame
    small = shrunk(frame, factor)
    height, width = 40 // factor, 48 // factor
    assert small.rgb_u8.shape == (height, width, 3) and (small.camera.width, small.camera.height) == (width, height)
    for v in range(height):
        for u in range(width):
            block = np.s_[factor * v : factor * (v + 1), factor * u : factor * (u + 1)]
            assert small.tissue_mask[v, u] == frame.tissue_mask[block].all()
            assert small.depth_valid[v, u] == frame.depth_valid[block].all()
            depth = frame.depth[block].mean() if frame.depth_valid[block].all() else 0
            assert small.depth[v, u] == pytest.approx(depth, rel=1e-6)  # float32 means
            mean = frame.rgb_u8[block].reshape(-1, 3).mean(0)
            np.testing.assert_allclose(small.rgb_u8[v, u], mean, atol=0.51)  # rounding of each average


def test_loading_small_is_shrinking_what_was_loaded(tiny_sequence):
    small = load_sequence(tiny_sequence, DataConfig(shrink=2))
    frame, expected = small.frame(5), shrunk(load_sequence(tiny_sequence).frame(5), 2)
    for name in ("rgb_u8", "tissue_mask", "depth", "depth_valid"):
        np.testing.assert_array_equal(getattr(frame, name), getattr(expected, name))
    assert small.camera(5).fx == frame.camera.fx == 25 and small.validate() == []


def test_first_frames_are_a_shorter_sequence(tiny_sequence, tmp_path):
    short = load_sequence(tiny_sequence, DataConfig(first_frames=9))
    assert len(short) == 9 and short.indices("test") == [1] and short.frame(3).time == 3 / 9
    write_tiny_sequence(tmp_path / "changed")
    (tmp_path / "changed" / "images" / "000012.png").write_bytes(b"not used")
    assert load_sequence(tmp_path / "changed", DataConfig(first_frames=9)).fingerprint() == short.fingerprint()
    assert len(load_sequence(tiny_sequence, DataConfig(first_frames=99))) == 17


def test_ground_truth_is_left_out_with_a_note(tiny_sequence):
    (tiny_sequence / "truth").mkdir()
    assert load_sequence(tiny_sequence).truth is not None
    for cfg in (DataConfig(shrink=2), DataConfig(first_frames=9)):
        part = load_sequence(tiny_sequence, cfg)
        assert part.truth is None and any("truth" in remark for remark in part.validate())
