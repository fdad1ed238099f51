"""Hamlyn: Forplane's folders with their crop, and the rectified ones with intrinsics.txt."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
from reader_checks import assert_rejected, remark_with
from sequence_edits import change_poses, write

from endoprior.core.config import DataConfig
from endoprior.data import load_sequence

WIDTH, HEIGHT, FRAMES = 64, 48, 10


@pytest.fixture
def forplane(tmp_path):
    """Depth is the column number + 100, masks mark the right-most 4 columns, red shows the column."""
    folder = tmp_path / "hamlyn1"
    columns = np.tile(np.arange(WIDTH), (HEIGHT, 1))
    for name in ("images", "gt_masks", "gt_depth"):
        (folder / name).mkdir(parents=True)
    for i in range(FRAMES):
        color = np.stack([0 * columns, 0 * columns + i, columns], -1)
        write(folder / f"images/{i:06d}.png", color.astype(np.uint8))
        write(folder / f"gt_masks/{i:06d}.png", (255 * (columns >= 60)).astype(np.uint8))
        write(folder / f"gt_depth/{i:06d}.png", (columns + 100).astype(np.uint16))
    row = np.column_stack([np.eye(3), np.zeros(3), (HEIGHT, WIDTH, 70)]).ravel()
    np.save(folder / "poses_bounds.npy", np.tile(np.append(row, (0, 1)), (FRAMES, 1)))
    return folder


@pytest.fixture
def rectified(tmp_path):
    folder = tmp_path / "rectified08"
    for name in ("image01", "depth01"):
        (folder / name).mkdir(parents=True)
    for i in range(FRAMES):
        assert cv2.imwrite(str(folder / f"image01/{i:010d}.jpg"), np.full((HEIGHT, WIDTH, 3), 10 * i, np.uint8))
        write(folder / f"depth01/{i:010d}.png", np.full((HEIGHT, WIDTH), 80 + i, np.uint16))
    (folder / "intrinsics.txt").write_text("70.5 0 30.25 0\n0 71 20 0\n# last row\n\n0 0 1 0\n\n")
    return folder


def test_forplane_is_cropped_and_its_camera_with_it(forplane):
    seq = load_sequence(forplane)
    camera, frame = seq.camera(0), seq.frame(7)
    assert (camera.width, camera.height, camera.fx, camera.fy) == (24, 48, 70, 70)
    assert (camera.cx, camera.cy) == (WIDTH / 2 - 40, HEIGHT / 2)
    assert (frame.rgb_u8[0, :, 0] == np.arange(40, 64)).all() and (frame.rgb_u8[..., 1] == 7).all()
    assert frame.tissue_mask[:, :20].all() and not frame.tissue_mask[:, 20:].any()
    assert frame.depth[3, 5] == 145 and remark_with(forplane, "40 empty columns")


def test_forplane_unit_is_assumed_until_given(forplane):
    assert load_sequence(forplane).depth_is_relative and remark_with(forplane, "unit is not documented")
    cfg = DataConfig(depth_unit_mm=0.5)
    seq = load_sequence(forplane, cfg)
    assert seq.frame(0).depth[3, 5] == 72.5 and not seq.depth_is_relative
    assert not remark_with(forplane, "unit is not documented", cfg)


def test_forplane_with_the_folder_names_of_endonerf(forplane):
    (forplane / "gt_depth").rename(forplane / "depth")
    (forplane / "gt_masks").rename(forplane / "masks")
    assert load_sequence(forplane).camera(0).width == 24  # known by its name
    assert load_sequence(forplane, DataConfig(format="endonerf")).camera(0).width == 64
    (forplane / "sequence.json").write_text("{}")  # as `endoprior prepare` leaves it
    assert load_sequence(forplane).camera(0).width == 64


def test_rectified(rectified):
    seq = load_sequence(rectified)
    camera, frame = seq.camera(4), seq.frame(4)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (70.5, 71, 30.75, 20.5)
    assert (frame.rgb_u8 == 40).all() and (frame.depth == 84).all() and frame.tissue_mask.all()
    assert not seq.depth_is_relative and remark_with(rectified, "camera is assumed to be static")
    assert len(load_sequence(rectified, DataConfig(stride=4))) == 3


def test_rectified_calibration_of_the_whole_set(rectified):
    place = rectified.parent / "calibration/08"
    place.mkdir(parents=True)
    (rectified / "intrinsics.txt").rename(place / "intrinsics.txt")
    seq = load_sequence(rectified)
    assert seq.camera(0).fx == 70.5 and len(seq.fingerprint()) == 64


FORPLANE_BAD = {
    "fewer depths": (lambda f: (f / "gt_depth/000003.png").unlink(), "gt_depth", "10 files, one per image, got 9"),
    "no masks": (lambda f: shutil.rmtree(f / "gt_masks"), "masks", "no such folder"),
    "no poses": (lambda f: (f / "poses_bounds.npy").unlink(), "poses_bounds.npy", "no such file"),
    "pose NaN": (lambda f: change_poses(f, lambda p: p * np.nan), "poses_bounds.npy", "finite numbers"),
    "focal": (
        lambda f: change_poses(f, lambda p: np.where(np.arange(17) == 14, -1, p)),
        "poses_bounds.npy",
        "focal length > 0",
    ),
    "depth cut": (lambda f: (f / "gt_depth/000003.png").write_bytes(b""), "gt_depth/000003.png", "0 bytes"),
    "narrow": (
        lambda f: [write(p, np.zeros((4, 40, 3), np.uint8)) for p in (f / "images").iterdir()],
        "images/000000.png",
        "more than 40 columns",
    ),
}
RECTIFIED_BAD = {
    "fewer depths": (lambda f: (f / "depth01/0000000003.png").unlink(), "depth01", "got 9"),
    "no calibration": (lambda f: (f / "intrinsics.txt").unlink(), "intrinsics.txt", "No such file"),
    "calibration words": (lambda f: (f / "intrinsics.txt").write_text("fx 70\n"), "intrinsics.txt", "rows of numbers"),
    "calibration shape": (lambda f: (f / "intrinsics.txt").write_text("1 2\n"), "intrinsics.txt", "3x3 camera matrix"),
    "jpeg cut": (
        lambda f: (f / "image01/0000000003.jpg").write_bytes((f / "image01/0000000003.jpg").read_bytes()[:200]),
        "image01/0000000003.jpg",
        "cannot be decoded",
    ),
}


@pytest.mark.parametrize("case", FORPLANE_BAD)
def test_bad_forplane_folders_are_rejected(forplane, case):
    damage, named, words = FORPLANE_BAD[case]
    damage(forplane)
    assert_rejected(forplane, named, words)


@pytest.mark.parametrize("case", RECTIFIED_BAD)
def test_bad_rectified_folders_are_rejected(rectified, case):
    damage, named, words = RECTIFIED_BAD[case]
    damage(rectified)
    assert_rejected(rectified, named, words)
