"""What is written is what is read, for generated sizes, counts, scales and polarities; and what is rejected."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np
import pytest
from frame_strategies import SEEDS, depths, masks, pictures
from hypothesis import given
from hypothesis import strategies as st
from hypothesis_profiles import examples
from scipy.spatial.transform import Rotation
from sequence_edits import describe

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence, pixels
from endoprior.data.pixels import is_measured
from endoprior.data.writer import SequenceMeta, new_sequence


@st.composite
def recordings(draw):
    """Facts, and (rgb, tool mask, depth) of 2 to 10 frames with poses."""
    height, width, count = draw(st.integers(1, 14)), draw(st.integers(1, 14)), draw(st.integers(2, 10))
    meta = SequenceMeta(
        width=width,
        height=height,
        fx=draw(st.floats(1, 2000)),
        fy=draw(st.floats(1, 2000)),
        cx=draw(st.floats(0.1, 20)),
        cy=draw(st.floats(0.1, 20)),
        frames_per_second=draw(st.floats(1, 120)),
        depth_scale=draw(st.sampled_from([0.001, 0.01, 0.25, 1.0])),
    )
    frames = [
        (draw(pictures(height, width)), draw(masks(height, width)), np.minimum(draw(depths(height, width)), 1e30))
        for _ in range(count)
    ]
    rng = np.random.default_rng(draw(SEEDS))
    poses = np.tile(np.eye(4), (count, 1, 1))
    if draw(st.booleans()):
        poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(count, 3))).as_matrix()
        poses[:, :3, 3] = rng.normal(size=(count, 3)) * 50
    return meta, frames, poses


def written(folder: Path, meta, frames, poses):
    """The folder, after the frames were written to it."""
    with new_sequence(folder, meta) as writer:
        for rgb, tool, depth in frames:
            writer.add(rgb, tool, depth)
        writer.camera_to_world = poses
    return folder


def stored_depth(depth, scale):
    """mm that 16 bits of `scale` mm each can hold; 0 where there is no depth, or it is too far."""
    units = np.round(np.where(np.isfinite(depth) & (depth > 0), depth, 0) / np.float32(scale))
    units = np.where(units < 65535, units, 0)
    return np.where(is_measured(units), units, 0).astype(np.float64) * scale


@pytest.mark.slow
@examples(25)
@given(recordings())
def test_what_was_written_is_read(made):
    meta, frames, poses = made
    with TemporaryDirectory() as place, mock.patch.object(pixels, "CLIP_PERCENTILES", (0, 100)):
        sequence = load_sequence(written(Path(place) / "sequence", *made))
        assert len(sequence) == len(frames) and sequence.frames_per_second == meta.frames_per_second
        for i, (rgb, tool, depth) in enumerate(frames):
            frame = sequence.frame(i)
            assert frame.index == i and frame.time == i / len(frames)
            assert np.array_equal(frame.rgb_u8, rgb) and np.array_equal(frame.tissue_mask, ~tool)
            want = stored_depth(depth, meta.depth_scale)
            assert np.array_equal(frame.depth_valid, want > 0)
            np.testing.assert_allclose(frame.depth, want, rtol=1e-6)
            camera = frame.camera
            assert (camera.fx, camera.fy, camera.cx, camera.cy) == (meta.fx, meta.fy, meta.cx, meta.cy)
            np.testing.assert_allclose(camera.world_to_camera @ poses[i], np.eye(4), atol=1e-9)
        assert sorted(sequence.indices("train") + sequence.indices("test")) == sequence.indices("video")


@pytest.mark.slow
@examples(15)
@given(recordings(), st.integers(1, 3), st.integers(1, 3))
def test_polarity_stride_and_shrink_change_what_they_say(made, stride, shrink):
    meta, frames, _ = made
    with TemporaryDirectory() as place:
        folder = written(Path(place) / "sequence", *made)
        describe(folder, mask_tool_value=0)
        cfg = DataConfig(stride=stride, shrink=shrink)
        left = -(-len(frames) // stride)
        if left < 2 or min(meta.width, meta.height) < shrink:
            with pytest.raises(InputError, match="expected at least 2 frames of 1x1 px"):
                load_sequence(folder, cfg)
            return
        sequence = load_sequence(folder, cfg)
        assert len(sequence) == left
        for i in range(left):
            frame, (rgb, tool, _) = sequence.frame(i), frames[i * stride]
            assert frame.rgb_u8.shape == (meta.height // shrink, meta.width // shrink, 3)
            assert (frame.camera.width, frame.camera.height) == (meta.width // shrink, meta.height // shrink)
            if shrink == 1:
                assert np.array_equal(frame.tissue_mask, tool) and np.array_equal(frame.rgb_u8, rgb)


@pytest.mark.slow
@examples(15)
@given(recordings())
def test_exactly_the_unusable_is_rejected(made):
    meta, frames, _ = made
    with TemporaryDirectory() as place:
        sequence = load_sequence(written(Path(place) / "sequence", *made))
        tissue = [~tool for _, tool, _ in frames]
        known = [stored_depth(depth, meta.depth_scale) > 0 for _, _, depth in frames]
        train = sequence.indices("train")
        usable = any((tissue[i] & known[i]).any() for i in train)
        if usable:
            levels = [frames[i][0][tissue[i] & known[i]].min(-1) for i in train]
            if sum((each < 250).sum() for each in levels) < 0.01 * sum(map(len, levels)):
                with pytest.raises(InputError, match="the images are white"):
                    sequence.validate()
                return
            assert all("\n" not in remark for remark in sequence.validate())
            return
        with pytest.raises(InputError) as refusal:
            sequence.validate()
        expected = (
            "tissue in at least one frame" if not any(t.any() for t in tissue)
            else "depth > 0 in at least one frame" if not any(k.any() for k in known)
            else "depth on tissue in a training frame"
        )  # fmt: skip
        assert f"expected {expected}, got " in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.mark.slow
@examples(25)
@given(recordings(), st.floats(0, 100), st.floats(0, 100), st.booleans())
def test_cleaned_depth_stays_within_what_was_measured(made, one, other, lift):
    meta, frames, _ = made
    low, high = sorted((one, other))
    cfg = DataConfig(lift_missing_depth=lift)
    with TemporaryDirectory() as place, mock.patch.object(pixels, "CLIP_PERCENTILES", (low, high)):
        sequence = load_sequence(written(Path(place) / "sequence", *made), cfg)
        for i, (_, _, depth) in enumerate(frames):
            frame, want = sequence.frame(i), stored_depth(depth, meta.depth_scale)
            assert np.isfinite(frame.depth).all() and (frame.depth[~frame.depth_valid] == 0).all()
            if (want > 0).any():
                known = frame.depth[frame.depth_valid]
                assert known.min() >= want[want > 0].min() * (1 - 1e-6) and known.max() <= want.max() * (1 + 1e-6)
                assert frame.depth_valid.all() if lift else np.array_equal(frame.depth_valid, want > 0)
            else:
                assert not frame.depth_valid.any()
