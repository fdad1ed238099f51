"""Hamlyn: Forplane's folders with their crop, and the rectified ones with intrinsics.txt; margins are no tissue."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
from known_surface import off_the_plane, seen
from reader_checks import assert_damage_is_rejected, assert_rejected, remark_with
from sequence_edits import change_poses, write

from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.footage.border import find_outside

WIDTH, HEIGHT, FRAMES = 64, 48, 10
CROP = 4
"""40 columns of 640."""
MATRIX = np.array([[700.0, 0, 345.5], [0, 690, 215.5], [0, 0, 1]])
"""intrinsics.txt of images of 640x480 px; pixel centers are integers."""
IN_PIXELS = np.array([[70.0, 0, 34.6], [0, 69, 21.6], [0, 0, 1]])
"""The same camera in px of ours, with pixel centers at halves."""


@pytest.fixture
def forplane(tmp_path):
    """Depth is the column number + 100, masks mark the right-most 4 columns, red shows the column + 60."""
    folder = tmp_path / "hamlyn1"
    columns = np.tile(np.arange(WIDTH), (HEIGHT, 1))
    for name in ("images", "gt_masks", "gt_depth"):
        (folder / name).mkdir(parents=True)
    for i in range(FRAMES):
        color = np.stack([0 * columns, 0 * columns + i, columns + 60], -1)
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
    assert (camera.width, camera.height, camera.fx, camera.fy) == (60, 48, 70, 70)
    assert (camera.cx, camera.cy) == (WIDTH / 2 - CROP, HEIGHT / 2)
    assert (frame.rgb_u8[0, :, 0] == np.arange(CROP, 64) + 60).all() and (frame.rgb_u8[..., 1] == 7).all()
    assert frame.tissue_mask[:, :56].all() and not frame.tissue_mask[:, 56:].any()
    assert frame.depth[3, 5] == 109 and remark_with(forplane, "4 empty columns")


def test_forplane_unit_is_assumed_until_given(forplane):
    assert load_sequence(forplane).depth_is_relative and remark_with(forplane, "unit is not documented")
    cfg = DataConfig(depth_unit_mm=0.5)
    seq = load_sequence(forplane, cfg)
    assert seq.frame(0).depth[3, 5] == 54.5 and not seq.depth_is_relative
    assert not remark_with(forplane, "unit is not documented", cfg)


def test_forplane_with_the_folder_names_of_endonerf(forplane):
    (forplane / "gt_depth").rename(forplane / "depth")
    (forplane / "gt_masks").rename(forplane / "masks")
    assert load_sequence(forplane).camera(0).width == 60  # known by its name
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
    places = ("../calibration/08/intrinsics.txt", "../intrinsics_rectified08.txt", "intrinsic/intrinsic_color.txt")
    now = rectified / "intrinsics.txt"
    for place in (*places, "intrinsics_rectified08.txt"):
        (rectified / place).resolve().parent.mkdir(parents=True, exist_ok=True)
        now = now.rename((rectified / place).resolve())
        seq = load_sequence(rectified)
        assert seq.camera(0).fx == 70.5 and len(seq.fingerprint()) == 64


def test_videos_for_tracking(rectified):
    (rectified / "image01").rename(rectified / "color")
    (rectified / "depth01").rename(rectified / "depth")
    seq = load_sequence(rectified)
    assert seq.camera(0).cx == 30.75 and (seq.frame(4).depth == 84).all() and not seq.depth_is_relative
    (rectified / "pose").mkdir()  # another dataset of color and depth, whose poses would be lost
    assert_rejected(rectified, "rectified08", "one of the layouts")


def as_forplane_reads_it(folder, depth_folder):
    """The plane that a static camera sees; depth is in 0.01 mm."""
    color, depth = seen(IN_PIXELS, np.eye(4), (WIDTH, HEIGHT))
    for name in ("images", "gt_masks", depth_folder):
        (folder / name).mkdir(parents=True)
    for i in range(FRAMES):
        write(folder / f"images/{i:06d}.png", color[..., ::-1])
        write(folder / f"gt_masks/{i:06d}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
        write(folder / f"{depth_folder}/{i:06d}.png", np.rint(100 * depth).astype(np.uint16))
    np.savetxt(folder / "intrinsics.txt", MATRIX)
    return folder


@pytest.mark.parametrize(("name", "depth_folder"), [("hamlyn1", "pred_disp"), ("seq1", "pred_disp"), ("s", "gt_depth")])
def test_points_lie_on_the_plane_by_intrinsics_txt(tmp_path, name, depth_folder):
    folder, cfg = as_forplane_reads_it(tmp_path / name, depth_folder), DataConfig(depth_unit_mm=0.01)
    seq = load_sequence(folder, cfg)
    camera = seq.camera(0)
    assert (camera.fx, camera.fy) == (70, 69) and (camera.cx, camera.cy) == pytest.approx((34.6 - CROP, 21.6))
    assert off_the_plane(seq, 3) < 0.02  # depth is rounded to 0.01 mm
    assert remark_with(folder, "its name says disparity") == (depth_folder == "pred_disp")
    assert remark_with(folder, "scaled to 70 px for 64x48")


def test_intrinsics_txt_wins_over_poses(tmp_path, forplane):
    shutil.copy(forplane / "poses_bounds.npy", as_forplane_reads_it(tmp_path / "seq4", "gt_depth"))
    assert off_the_plane(load_sequence(tmp_path / "seq4", DataConfig(depth_unit_mm=0.01)), 3) < 0.02
    assert remark_with(tmp_path / "seq4", "not used; intrinsics.txt is the calibration")


def test_intrinsics_txt_in_px_of_the_images(tmp_path):
    folder = as_forplane_reads_it(tmp_path / "seq5", "gt_depth")
    np.savetxt(folder / "intrinsics.txt", IN_PIXELS - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    assert off_the_plane(load_sequence(folder, DataConfig(depth_unit_mm=0.01)), 0) < 0.02
    np.savetxt(folder / "intrinsics.txt", np.diag([3, 3, 1]) @ MATRIX)  # of 1920x1440 px
    assert_rejected(folder, "intrinsics.txt", "a principal point near the center of 64x48 px, got cx 1037, cy 647")


def test_endonerf_in_the_folders_of_forplane_is_not_cropped(forplane):
    folder = forplane.rename(forplane.parent / "pulling")
    for file in folder.rglob("*.png"):
        write(file, np.pad(cv2.imread(str(file), -1), [(0, 3), (0, 0), (0, 0)][: cv2.imread(str(file), -1).ndim]))
    change_poses(folder, lambda p: np.where(np.arange(17) == 4, HEIGHT + 3, p))
    camera = load_sequence(folder).camera(0)
    assert (camera.width, camera.cx, camera.height) == (WIDTH, WIDTH / 2, HEIGHT + 3)
    assert remark_with(folder, "read as EndoNeRF's")


def test_a_black_margin_is_no_tissue(rectified):
    """Rectification leaves 9 rows at the top and a triangle at the left without color."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    margin = (rows < 9) | (columns < 20 - rows // 2)
    for i in range(FRAMES):
        color = rng.integers(60, 200, (HEIGHT // 8, WIDTH // 8, 3), np.uint8).repeat(8, 0).repeat(8, 1)
        color[30:40, 40:60] = 8  # dark tissue inside is not connected to the edge
        color[margin] = 0
        assert cv2.imwrite(str(rectified / f"image01/{i:010d}.jpg"), color)
    tissue = load_sequence(rectified).frame(2).tissue_mask
    assert tissue[margin].mean() < 0.002  # less than two pixels of where it is narrow
    near = cv2.dilate(margin.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert tissue[~near].all() and remark_with(rectified, "black margin")


def test_vignetting_is_no_margin():
    y, x = np.mgrid[-1:1:48j, -1:1:64j]
    falloff = np.clip(1 - 0.5 * (x * x + y * y), 0.02, None)[..., None]
    images = [(150 * falloff + i % 3 + np.zeros(3)).astype(np.uint8) for i in range(10)]
    assert images[0].min() < 12 and not find_outside(images).mask.any()


FORPLANE_BAD = {
    "no masks": (lambda f: shutil.rmtree(f / "gt_masks"), "masks", "no such folder"),
    "no poses": (lambda f: (f / "poses_bounds.npy").unlink(), "poses_bounds.npy", "no such file"),
    "pose NaN": (lambda f: change_poses(f, lambda p: p * np.nan), "poses_bounds.npy", "finite numbers"),
    "focal": (
        lambda f: change_poses(f, lambda p: np.where(np.arange(17) == 14, -1, p)),
        "poses_bounds.npy",
        "focal length > 0",
    ),
    "depth cut": (lambda f: (f / "gt_depth/000003.png").write_bytes(b""), "gt_depth/000003.png", "0 bytes"),
}
RECTIFIED_BAD = {
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
    assert_damage_is_rejected(forplane, *FORPLANE_BAD[case])


@pytest.mark.parametrize("case", RECTIFIED_BAD)
def test_bad_rectified_folders_are_rejected(rectified, case):
    assert_damage_is_rejected(rectified, *RECTIFIED_BAD[case])
