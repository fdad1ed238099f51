"""The sequence writer: whole or not at all, in the layout the readers expect."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.data.writer import SequenceMeta, new_sequence

META = SequenceMeta(width=6, height=4, fx=5.0, fy=5.5, cx=3.0, cy=2.0, frames_per_second=25.0, depth_source="test")


def image(value=7):
    """(4, 6, 3) with a red ramp, so that swapped channels or axes would show."""
    pixels = np.full((4, 6, 3), value, np.uint8)
    pixels[..., 0] = np.arange(24).reshape(4, 6)
    return pixels


def test_round_trip(tmp_path):
    mask = np.zeros((4, 6), bool)
    mask[1, 2] = True
    depth = np.full((4, 6), 51.234, np.float32)
    depth[0, 0], depth[0, 1], depth[0, 2] = np.nan, -3, 60
    with new_sequence(tmp_path / "out", META) as writer:
        writer.add(image(), mask, depth)
        assert not (tmp_path / "out").exists()  # it appears whole
    assert np.array_equal(cv2.imread(str(tmp_path / "out/images/000000.png"))[..., ::-1], image())
    assert np.array_equal(cv2.imread(str(tmp_path / "out/masks/000000.png"), -1), np.where(mask, 255, 0))
    stored = cv2.imread(str(tmp_path / "out/depth/000000.png"), -1)
    assert stored.dtype == np.uint16 and stored[0, :4].tolist() == [0, 0, 6000, 5123]
    pose = np.load(tmp_path / "out/poses_bounds.npy")
    assert pose[0, :15].tolist() == [1, 0, 0, 0, 4, 0, 1, 0, 0, 6, 0, 0, 1, 0, 5.0]
    assert pose[0, 15:] == pytest.approx([51.23, 60])  # as stored
    described = json.loads((tmp_path / "out/sequence.json").read_text())
    assert described["fy"] == 5.5 and described["baseline_mm"] is None and described["frames_per_second"] == 25
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_nothing_is_left_after_an_error(tmp_path):
    with pytest.raises(RuntimeError), new_sequence(tmp_path / "deep/out", META) as writer:
        writer.add(image(), np.zeros((4, 6), bool))
        raise RuntimeError
    assert not list((tmp_path / "deep").iterdir())
    with pytest.raises(ValueError, match="at least one frame"), new_sequence(tmp_path / "out", META):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["deep"]


def test_unusable_places_and_arrays_are_named(tmp_path):
    (tmp_path / "file").write_text("x")
    for place in ("file", "file/under"):
        with pytest.raises(InputError, match=place), new_sequence(tmp_path / place, META):
            pass
    with pytest.raises(ValueError, match="tool_mask"), new_sequence(tmp_path / "out", META) as writer:
        writer.add(image(), np.zeros((6, 4), bool))


def test_arrays_are_stored_alone_by_any_version_of_numpy(tmp_path, monkeypatch):
    """NumPy below 2.1 stores every keyword as an array: `allow_pickle` would be one."""
    keywords = []
    monkeypatch.setattr(np, "savez_compressed", lambda _file, **arrays: keywords.extend(arrays))
    with new_sequence(tmp_path / "S", META) as writer:
        writer.write_arrays("truth/tracks.npz", points=np.zeros(3))
        writer.add(image(), np.zeros((4, 6), bool))
    assert keywords == ["points"]
