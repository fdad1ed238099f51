"""Plain folders: images alone, or with masks, depth of any kind, and sequence.json."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from reader_checks import assert_damage_is_rejected, assert_rejected, remark_with
from sequence_edits import write

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence

WIDTH, HEIGHT, FRAMES = 30, 20, 12


@pytest.fixture
def plain(tmp_path):
    (tmp_path / "images").mkdir()
    for i in range(FRAMES):
        assert cv2.imwrite(str(tmp_path / f"images/{i}.jpg"), np.full((HEIGHT, WIDTH, 3), 10 * i, np.uint8))
    return tmp_path


def add_depth(folder, suffix=".npy"):
    (folder / "depth").mkdir()
    for i in range(FRAMES):
        depth = np.full((HEIGHT, WIDTH), 40 + i, np.float32)
        depth[0, 0] = np.nan
        path = folder / f"depth/{i}{suffix}"
        if suffix == ".npy":
            np.save(path, depth)
        else:
            write(path, depth)


def test_images_alone(plain):
    seq = load_sequence(plain)
    camera, frame = seq.camera(3), seq.frame(10)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (27, 27, 15, 10)
    np.testing.assert_array_equal(camera.world_to_camera, np.eye(4))
    assert (frame.rgb_u8 == 100).all() and frame.tissue_mask.all() and not frame.depth_valid.any()
    with pytest.raises(InputError, match="depth > 0 in at least one frame"):
        seq.validate()


def test_a_camera_matrix_beside_the_images_counts(plain):
    (plain / "intrinsics.txt").write_text("31 0 14 0\n0 32 9 0\n0 0 1 0\n")
    seq = load_sequence(plain)
    camera, before = seq.camera(3), seq.fingerprint()
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (31, 32, 14.5, 9.5)
    assert not any("no focal length" in remark for remark in seq.remarks)
    (plain / "intrinsics.txt").write_text("30 0 14\n0 32 9\n0 0 1\n")
    assert load_sequence(plain).fingerprint() != before
    (plain / "sequence.json").write_text('{"fx": 40}')
    assert load_sequence(plain).camera(3).fx == 40


@pytest.mark.parametrize("suffix", [".npy", ".tiff"])
def test_depth_of_another_kind(plain, suffix):
    add_depth(plain, suffix)
    seq = load_sequence(plain)
    frame = seq.frame(11)
    assert frame.depth[5, 5] == 51 and not frame.depth_valid[0, 0] and frame.depth[0, 0] == 0
    assert seq.depth_is_relative
    for words in ("no unit given", "every pixel counts as tissue", "0.9 image widths (27 px)", "assumed to be static"):
        assert remark_with(plain, words)


def test_unit_of_the_option_and_of_the_description(plain):
    add_depth(plain)
    (plain / "sequence.json").write_text(json.dumps({"depth_scale": 0.5}))
    assert load_sequence(plain).frame(0).depth[5, 5] == 20 and not load_sequence(plain).depth_is_relative
    assert load_sequence(plain, DataConfig(depth_unit_mm=2)).frame(0).depth[5, 5] == 80


def test_description_and_masks(plain):
    add_depth(plain)
    (plain / "masks").mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :6] = 255
    for i in range(FRAMES):
        write(plain / f"masks/{i}.png", mask)
    described = {"fx": 33, "cx": 14.5, "frames_per_second": 30, "mask_tool_value": 0, "depth_relative": False}
    described |= {"sources": {"depth": "me"}, "unexplained_frames": [4, 2], "format_version": 1}
    (plain / "sequence.json").write_text(json.dumps(described))
    seq = load_sequence(plain, DataConfig(stride=2))
    camera = seq.camera(0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (33, 33, 14.5, 10)
    assert len(seq) == 6 and seq.frames_per_second == 15 and seq.sources == {"depth": "me"}
    assert seq.frame(0).tissue_mask[:, :6].all() and not seq.frame(0).tissue_mask[:, 6:].any()
    assert seq.frame(1).rgb_u8[0, 0, 0] == 20 and not seq.depth_is_relative
    assert seq.left_out == [1, 2] and remark_with(plain, "2 of 12 frames have no camera pose")
    assert not remark_with(plain, "image widths")


def test_endonerf_folder_without_poses_is_plain_only_on_request(tiny_sequence):
    (tiny_sequence / "poses_bounds.npy").unlink()
    assert_rejected(tiny_sequence, "poses_bounds.npy", "set data.format to plain")
    seq = load_sequence(tiny_sequence, DataConfig(format="plain"))
    assert len(seq) == 17 and seq.camera(0).fx == 50 and not seq.depth_is_relative


def test_a_jpeg_that_ends_early_is_rejected(plain, capfd):
    """Decoders fill what is missing with gray and say so on stderr."""
    add_depth(plain)
    path = plain / "images/3.jpg"
    assert cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
    path.write_bytes(path.read_bytes()[:-100])
    assert_rejected(plain, "images/3.jpg", "cannot be decoded")
    assert capfd.readouterr().err == ""


def describe(**described):
    return lambda f: (f / "sequence.json").write_text(json.dumps(described))


BAD = {
    "depth cut": (lambda f: (f / "depth/3.npy").write_bytes(b"x"), "depth/3.npy", "a NumPy file"),
    "depth of other size": (lambda f: np.save(f / "depth/3.npy", np.ones((2, 3))), "depth/3.npy", "got 3x2"),
    "empty masks": (lambda f: (f / "masks").mkdir(), "masks", "PNG files, got none"),
    "truncated image": (
        lambda f: (f / "images/3.jpg").write_bytes((f / "images/3.jpg").read_bytes()[:300]),
        "images/3.jpg",
        "cannot be decoded",
    ),
    "size": (describe(width=31, height=20), "sequence.json", "size 30x20, got 31x20"),
    "fx": (describe(fx=-1), "sequence.json", "fx to be a number in [1e-06, 1e+06]"),
    "relative": (describe(depth_relative=1), "sequence.json", "depth_relative true or false, got 1"),
    "sources": (describe(sources={"depth": 1}), "sequence.json", "sources to map names to texts"),
    "sources list": (describe(sources=["a"]), "sequence.json", "sources to map names to texts"),
    "frames": (describe(unexplained_frames=[1.5]), "sequence.json", "a list of frame numbers"),
    "frames outside": (describe(unexplained_frames=[12]), "sequence.json", "in 0..11, got 12"),
    "version": (describe(format_version=2), "sequence.json", "1 to 1, got 2. Fix: Update endoprior"),
    "version text": (describe(format_version="1"), "sequence.json", "format_version 1 to 1, got '1'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_folders_are_rejected(plain, case):
    add_depth(plain)
    assert_damage_is_rejected(plain, *BAD[case])


def test_gt_masks_must_exist_if_the_option_names_them(plain):
    assert_rejected(plain, "gt_masks", "no such folder", DataConfig(use_gt_masks=True))
