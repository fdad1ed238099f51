"""C3VD: names, 16-bit depth, pose order, and the omnidirectional images against their formula."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from known_surface import color_change, of_rays, off_the_plane, turned
from known_surface import pose as plane_pose
from reader_checks import assert_damage_is_rejected, remark_with
from sequence_edits import write

from endoprior.check.facts import measure
from endoprior.check.findings import find
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.data.c3vd import CF_HQ190L, Omnidirectional, camera_to_world

LENS = Omnidirectional(135, 108, 67.4, 53.8, 77.0, -8.1e-3, 6.3e-5, -1.2e-6, 0.9999, 0.003, -0.003)
FRAMES = 11


def rays(lens):
    """(H, W, 3) direction of every pixel: the model as its authors write it, pixel by pixel."""
    stretch = np.linalg.inv([[lens.c, lens.d], [lens.e, 1]])
    out = np.zeros((lens.height, lens.width, 3))
    for row in range(lens.height):
        for column in range(lens.width):
            x, y = stretch @ (column - lens.cx, row - lens.cy)
            rho = np.hypot(x, y)
            out[row, column] = x, y, lens.a0 + lens.a2 * rho**2 + lens.a3 * rho**3 + lens.a4 * rho**4
    return out


def pose(frame):
    angle = np.radians(3 * frame)
    matrix = np.eye(4)
    matrix[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    matrix[:3, 3] = (10 + frame, -20, 30)
    return matrix


def write_poses(folder, column_major=True, frames=FRAMES):
    rows = [(pose(i).T if column_major else pose(i)).ravel() for i in range(frames)]
    (folder / "pose.txt").write_text("\n".join(",".join(map(repr, row.tolist())) for row in rows) + "\n")


def write_video(folder, lens=LENS):
    """A wall at z = 25 mm, colored by (X / Z, Y / Z); the left 20 columns are masked, the top row is too far."""
    folder.mkdir(parents=True)
    direction = rays(lens)
    slope = direction[..., :2] / direction[..., 2:]
    color = np.stack([0 * slope[..., 0], 128 + 60 * slope[..., 1], 128 + 60 * slope[..., 0]], -1)
    stored = np.full((lens.height, lens.width), 16384, np.uint16)
    stored[0], stored[:, :20] = 65535, 0
    for i in range(FRAMES):
        color[..., 0] = i  # blue
        write(folder / f"{i}_color.png", np.rint(color).clip(0, 255).astype(np.uint8))
        write(folder / f"{i:04d}_depth.tiff", stored)
    write_poses(folder)
    write_lens(folder, lens)
    return folder


def write_lens(folder, lens, **changes):
    fields = {name: getattr(lens, name) for name in Omnidirectional.__dataclass_fields__} | changes
    lines = [f"{name} = {value!r}" for name, value in fields.items() if value is not None]
    (folder / "config.ini").write_text("\n".join(["[camera]", *lines, "A_cal = 1,0,0"]))


@pytest.fixture
def video(tmp_path):
    return write_video(tmp_path / "cecum_t1_a")


def test_the_plane_lands_on_itself(tmp_path):
    """A tilted, painted plane through the lens from moving poses; depth is z, 16 bit up to 100 mm."""
    folder = write_video(tmp_path / "trans_t1_a")
    direction = rays(LENS)
    poses = [plane_pose(turned(0.5 * i, -0.8 * i, 2 * i), (1.2 * i, -i, 0.9 * i)) for i in range(FRAMES)]
    for i, to_world in enumerate(poses):
        color, depth = of_rays(direction / direction[..., 2:], to_world)
        write(folder / f"{i}_color.png", color[..., ::-1])
        stored = np.where((depth > 0) & (depth < 100), np.rint(depth * 655.35), 65535)
        write(folder / f"{i:04d}_depth.tiff", stored.astype(np.uint16))
    (folder / "pose.txt").write_text("\n".join(",".join(map(repr, p.T.ravel().tolist())) for p in poses))
    seq = load_sequence(folder)
    assert off_the_plane(seq, 0) < 0.5 and off_the_plane(seq, 8) < 0.5  # depth is that of the nearest pixel
    assert color_change(seq, 0, 8) < 6 and color_change(seq, 8, 0) < 6


def test_check_does_not_advise_masks_that_are_not_read(video):
    for file in video.glob("*_depth.tiff"):
        write(file, np.full((LENS.height, LENS.width), 16384, np.uint16))
    assert not load_sequence(video).takes_masks
    (finding,) = (each for each in find(measure(load_sequence(video))) if each.code == "tool-fraction")
    assert finding.fix.endswith("this layout has no masks") and "paint" not in finding.fix


def test_frames_and_depths_match_by_number(video):
    seq = load_sequence(video)
    assert [seq.frame(i).rgb_u8[54, 67, 2] for i in (1, 2, 10)] == [1, 2, 10]  # 10 after 2, not after 1
    assert len(seq) == FRAMES and remark_with(video, "pinhole camera")


def test_pinhole_picture_shows_what_the_lens_saw(video):
    """Color is linear in (X / Z, Y / Z), so the pinhole image must be linear in x and y."""
    seq = load_sequence(video)
    camera, frame = seq.camera(0), seq.frame(0)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    inside = np.s_[10:-10, 30:-10]
    want_red = 128 + 60 * (x - camera.cx) / camera.fx
    want_green = 128 + 60 * (y - camera.cy) / camera.fy
    # Rounding to 8 bits on both sides, and bilinear lookup of a curved function.
    np.testing.assert_allclose(frame.rgb_u8[..., 0][inside], want_red[inside], atol=1.1)
    np.testing.assert_allclose(frame.rgb_u8[..., 1][inside], want_green[inside], atol=1.1)
    assert np.abs(frame.rgb_u8[..., 0][inside] - want_red[inside]).mean() < 0.4


def test_depth_is_z_and_keeps_its_value(video):
    frame = load_sequence(video).frame(0)
    middle = frame.depth[30:80, 40:100]
    np.testing.assert_allclose(middle, 16384 / 65535 * 100, rtol=1e-6)
    assert frame.depth_valid[30:80, 40:100].all()


def test_masked_corner_is_no_tissue_and_far_tissue_has_no_depth(video):
    for file in video.glob("*_depth.tiff"):
        stored = np.full((LENS.height, LENS.width), 65535, np.uint16)
        stored[:, :67] = 0
        stored[:, 90:] = 100
        write(file, stored)
    frame = load_sequence(video).frame(3)
    assert not frame.tissue_mask[:, :60].any() and frame.tissue_mask[:, 72:].all()
    assert not frame.depth_valid[:, 72:80].any() and frame.depth_valid[:, 110:].all()
    assert not frame.depth[~frame.depth_valid].any()


@pytest.mark.parametrize("lens", [LENS, CF_HQ190L], ids=["small", "CF-HQ190L"])
def test_maps_invert_the_model(lens):
    """The original pixel of each pinhole pixel must look along that pixel's ray."""
    focal, cx, cy = lens.pinhole()
    map_x, map_y = lens.pinhole_maps()
    stretch = np.linalg.inv([[lens.c, lens.d], [lens.e, 1]])
    for row in range(0, lens.height, lens.height // 6):
        for column in range(0, lens.width, lens.width // 6):
            x, y = stretch @ (float(map_x[row, column]) - lens.cx, float(map_y[row, column]) - lens.cy)
            z = lens.forward(np.float64(np.hypot(x, y)))
            want = ((column + 0.5 - cx) / focal, (row + 0.5 - cy) / focal)
            np.testing.assert_allclose((x / z, y / z), want, atol=1e-5)  # float32 maps, 1e-4 px of 1e3


def test_nearest_edge_of_the_picture_stays_the_nearest_edge():
    focal, cx, cy = CF_HQ190L.pinhole()
    assert (cx, cy) == (CF_HQ190L.cx + 0.5, CF_HQ190L.cy + 0.5)  # the axis stays where it was
    edge = CF_HQ190L.height - cy
    assert focal == pytest.approx(CF_HQ190L.forward(np.float64(edge)))
    assert 500 < focal < 560  # 45 degrees up and down


def test_poses_in_both_orders(video):
    want = load_sequence(video).camera(4)
    np.testing.assert_allclose(want.center, (14, -20, 30), atol=1e-12)
    np.testing.assert_allclose(want.world_to_camera, np.linalg.inv(pose(4)), atol=1e-12)
    write_poses(video, column_major=False)
    np.testing.assert_allclose(load_sequence(video).camera(4).world_to_camera, want.world_to_camera, atol=1e-12)


def test_depth_goes_by_the_pictures_number(video):
    (video / "3_color.png").unlink()
    rows = (video / "pose.txt").read_text().splitlines()
    (video / "pose.txt").write_text("\n".join(rows[:3] + rows[4:]))
    for i in range(FRAMES):
        write(video / f"{i:04d}_depth.tiff", np.full((LENS.height, LENS.width), 1000 * (i + 1), np.uint16))
    seq = load_sequence(video)
    assert [round(seq.frame(i).depth[50, 60] * 655.35) for i in range(len(seq))] == [
        1000 * (i + 1) for i in range(FRAMES) if i != 3
    ]
    np.testing.assert_allclose(seq.camera(3).center, (14, -20, 30), atol=1e-12)


def test_depth_is_not_clipped(video):
    stored = np.full((LENS.height, LENS.width), 16384, np.uint16)
    stored[48:52, 58:62] = 200
    write(video / "0000_depth.tiff", stored)
    assert load_sequence(video).frame(0).depth.min() == pytest.approx(200 / 655.35)


def test_the_published_lens_is_the_default(tmp_path):
    """Pictures of 1350 x 1080 px without a calibration file."""
    for i in range(2):
        write(tmp_path / f"{i}_color.png", np.full((1080, 1350, 3), 90, np.uint8))
        write(tmp_path / f"{i:04d}_depth.tiff", np.full((1080, 1350), 30000, np.uint16))
    write_poses(tmp_path, frames=2)
    frame = load_sequence(tmp_path).frame(1)
    assert frame.camera.fx == pytest.approx(CF_HQ190L.pinhole()[0])
    assert frame.tissue_mask.all() and (frame.rgb_u8 == 90).all()  # nothing black comes in at the corners


def test_still_camera_poses_are_column_major(tmp_path):
    (tmp_path / "pose.txt").write_text("0,1,0,0,-1,0,0,0,0,0,1,0,0,0,0,1\n")
    np.testing.assert_array_equal(camera_to_world(tmp_path / "pose.txt", 1)[0][:2, :2], [[0, -1], [1, 0]])


def pose_line(number, text):
    def change(folder):
        lines = (folder / "pose.txt").read_text().splitlines()
        lines[number] = text
        (folder / "pose.txt").write_text("\n".join(lines))

    return change


BAD = {
    "depth gone": (lambda f: (f / "0004_depth.tiff").unlink(), "0004_depth.tiff", "the depth of 4_color.png"),
    "no depth": (lambda f: [p.unlink() for p in f.glob("*.tiff")], "cecum_t1_a", "TIFF files, got none"),
    "fewer poses": (lambda f: write_poses(f, frames=5), "pose.txt", "11 rows of 16 numbers"),
    "short row": (pose_line(3, "1,2,3"), "pose.txt", "equally many numbers"),
    "word": (pose_line(3, ",".join("x" * 16)), "pose.txt", "rows of numbers"),
    "NaN": (pose_line(3, "1,0,0,0,0,1,0,0,0,0,1,0,nan,0,0,1"), "pose.txt", "finite rigid transforms"),
    "NaN rotation": (pose_line(3, "nan,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1"), "pose.txt", "finite rigid transforms"),
    "scaled": (pose_line(3, "2,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1"), "pose.txt", "another matrix in row 3"),
    "no pose.txt row": (pose_line(3, ",".join("1" * 16)), "pose.txt", "no row 0, 0, 0, 1"),
    "other camera": (lambda f: (f / "config.ini").unlink(), "0_color.png", "1350x1080 px, the calibrated size"),
    "no a2": (lambda f: write_lens(f, LENS, a2=None), "config.ini", "a number a2, got 'none'"),
    "no camera": (lambda f: write_lens(f, replace(LENS, a0=-1.0)), "config.ini", "the calibration of a camera"),
    "image cut": (lambda f: (f / "3_color.png").write_bytes(b"\x89PNG\r\n\x1a\n"), "3_color.png", "cannot be decoded"),
    "depth of other size": (
        lambda f: write(f / "0003_depth.tiff", np.ones((3, 4), np.uint16)),
        "0003_depth.tiff",
        "4x3",
    ),
    "name": (lambda f: (f / "3_color.png").rename(f / "x_color.png"), "x_color.png", "starts with the frame's number"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_videos_are_rejected(video, case):
    assert_damage_is_rejected(video, *BAD[case])


def test_unit_can_be_overridden(video):
    frame = load_sequence(video, DataConfig(depth_unit_mm=0.001)).frame(0)
    assert frame.depth[50, 60] == pytest.approx(16.384)
    assert cv2.countNonZero(frame.depth) > 5000
