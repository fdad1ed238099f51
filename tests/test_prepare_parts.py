"""The steps of `prepare`, one by one: stereo layout, geometry, file matching, work folder."""

import cv2
import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.footage.border import Strips
from endoprior.footage.round_border import Circle
from endoprior.prepare.calibration import Calibration, Intrinsics
from endoprior.prepare.config import PrepareConfig, parse_rectangle
from endoprior.prepare.frame_geometry import make_geometry
from endoprior.prepare.frames import REACH, MeasuredFrame, with_neighbors
from endoprior.prepare.stereo_layout import find_layout, split_cameras
from endoprior.prepare.work_folder import frames_done, work_folder


def smooth(height, width, seed=0, sigma=2.0):
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.random((height, width, 3), np.float32), (0, 0), sigma)
    return (255 * (noise - noise.min()) / np.ptp(noise)).astype(np.uint8)


def pair(shift=6):
    wide = smooth(64, 110)
    return wide[:, :96], wide[:, shift : shift + 96]


def test_split_cameras_inverts_every_layout():
    left, right = pair()
    for layout, frame in (("side-by-side", np.hstack([left, right])), ("top-bottom", np.vstack([left, right]))):
        assert all(np.array_equal(a, b) for a, b in zip(split_cameras(frame, layout), (left, right), strict=True))
    assert split_cameras(left, "mono")[1] is None


def test_interlaced_rows_keep_their_heights():
    ramp = np.repeat(np.arange(0, 240, 4, dtype=np.uint8)[:, None, None], 8, 1).repeat(3, 2)
    first, second = split_cameras(ramp, "interlaced")
    # A ramp is linear, so rows in between are exact; only the last (first) row has one neighbor of its own.
    assert np.array_equal(first[:-1], ramp[:-1]) and np.array_equal(second[1:], ramp[1:])


def stereo(size=None, layout=None):
    camera = Intrinsics(np.array([[90.0, 0, 48], [0, 90, 32], [0, 0, 1]]), np.zeros(5))
    return Calibration(camera, camera, np.eye(3), np.array([-4.0, 0, 0]), size, layout)


def test_the_layout_is_detected():
    left, right = pair()
    rows = np.empty((128, 96, 3), np.uint8)
    rows[::2], rows[1::2] = left, right
    frames = {"side-by-side": np.hstack([left, right]), "top-bottom": np.vstack([left, right]), "interlaced": rows}
    for layout, frame in frames.items():
        assert find_layout([frame], stereo(), False, "v") == layout  # by what it shows
    for layout in ("side-by-side", "top-bottom"):
        assert find_layout([np.zeros_like(frames[layout])], stereo((96, 64)), False, "v") == layout  # by its size
    assert find_layout([left], stereo(layout="left camera top-bottom"), False, "v") == "top-bottom"  # by what is said
    assert find_layout([left], None, False, "v") == "mono" and find_layout([left], None, True, "v") == "two-files"


def test_halves_with_the_same_shading_are_one_camera():
    """A tube is dark in its middle, and a fade-in scales it; its halves differ only in their details."""
    x = np.abs(np.linspace(-1, 1, 192))[None, :, None]
    bands = (np.abs(np.mod(np.linspace(0, 2, 128), 1) - 0.5) * 2)[:, None, None]
    rng = np.random.default_rng(0)
    tube = (40 + 80 * x + 80 * bands + rng.normal(0, 4, (128, 192, 3))).clip(0, 255)
    fading = [(tube * share).astype(np.uint8) for share in (0.05, 0.3, 1, 1)]
    assert find_layout(fading, None, False, "v") == "mono"


def test_an_unknown_layout_is_an_error():
    left, right = pair()
    with pytest.raises(InputError, match=r"v: expected two cameras in each frame, got 96x64 px.*--layout"):
        find_layout([smooth(64, 96)], stereo((50, 60)), False, "v")
    with pytest.raises(
        InputError, match=r"expected a calibration for a stereo video, got none, and a side-by-side frame"
    ):
        find_layout([np.hstack([left, right])], None, False, "v")


def test_one_camera_of_the_calibrated_size_is_not_taken_for_two():
    left, right = pair()
    with pytest.raises(InputError, match=r"v: expected two cameras in each frame, .* `--right VIDEO`"):
        find_layout([left], stereo((96, 64)), False, "v")
    half = np.hstack([cv2.resize(image, (48, 64), interpolation=cv2.INTER_AREA) for image in (left, right)])
    assert find_layout([half], stereo((96, 64)), False, "v") == "side-by-side"  # then its aspect ratio is wrong
    rows = left.copy()
    rows[1::2] = right[1::2]
    assert find_layout([rows], stereo((96, 64)), False, "v") == "interlaced"


def geometry_of(size, calibration=None, **options):
    base = {"stereo": False, "name": "c", "field_of_view_degrees": 90.0, "max_width": 0}
    return make_geometry(size, calibration, **(base | options))


def test_default_geometry_is_the_identity():
    geometry, image = geometry_of((97, 63)), smooth(63, 97)
    assert geometry.size == (97, 63) and np.array_equal(geometry.image(image), image) and geometry.inside.all()
    assert np.allclose(geometry.matrix, [[48.5, 0, 48.5], [0, 48.5, 31.5], [0, 0, 1]])  # 90 degrees across 97 px


def test_crop_and_resize_move_the_principal_point():
    geometry = geometry_of((200, 100), crop=(20, 10, 120, 80), max_width=60)
    assert geometry.size == (60, 40)
    assert np.allclose(geometry.matrix, [[50, 0, (100 - 20) / 2], [0, 50, (50 - 10) / 2], [0, 0, 1]])
    image = smooth(100, 200)
    want = cv2.resize(image[10:90, 20:140], (60, 40), interpolation=cv2.INTER_AREA)
    assert np.array_equal(geometry.image(image), want)


def test_strips_circle_and_blank_rectangles_are_excluded():
    circle = Circle(50, 40, 35)
    geometry = geometry_of((100, 80), strips=Strips(0, 10, 0, 0), circle=circle, blank=[(40, 30, 10, 5)])
    kept = circle.mask(100, 80, 0.025 * 35)
    kept[70:] = False
    rows, columns = np.flatnonzero(kept.any(1)), np.flatnonzero(kept.any(0))
    box = np.s_[rows[0] : rows[0] + geometry.size[1], columns[0] : columns[0] + geometry.size[0]]
    painted = np.zeros((80, 100), bool)
    painted[30:35, 40:50] = True
    assert np.array_equal(geometry.inside, (kept & ~painted)[box])
    assert np.allclose(geometry.matrix[:2, 2], (50 - columns[0], 40 - rows[0]))
    assert not geometry.image(np.full((80, 100, 3), 9, np.uint8))[painted[box]].any()


def test_masks_use_nearest_neighbor_at_either_size():
    geometry = geometry_of((200, 100), max_width=50)
    mask = np.random.default_rng(0).random((100, 200)) > 0.5
    assert geometry.size == (50, 25) and geometry.values(mask).shape == (25, 50) and geometry.values(mask).dtype == bool
    small = np.zeros(geometry.size[::-1], np.float32)  # made on frames
    assert geometry.values(small) is small


def test_a_pair_whose_images_have_their_centers_apart_is_shifted_together():
    """Rows fit already; of a point infinitely far away both frames have the same column."""
    left, right = (Intrinsics(np.array([[300.0, 0, cx], [0, 300, 120], [0, 0, 1]]), np.zeros(0)) for cx in (155, 171))
    calibration = Calibration(left, right, np.eye(3), np.array([-4.0, 0, 0]))
    geometry = geometry_of((320, 240), calibration, stereo=True)
    columns = []
    for camera in (left, right):
        image = np.zeros((240, 320, 3), np.uint8)
        at = int(camera.matrix[0, 2]) - 40
        image[100:140, at - 3 : at + 3] = 200
        seen = geometry.image(image, right=camera is right)[..., 0].astype(float)
        columns.append((seen.sum(0) * (np.arange(seen.shape[1]) + 0.5)).sum() / seen.sum())
    ray = geometry.matrix[0, 2] - 40 / 300 * geometry.matrix[0, 0]
    assert np.allclose(columns, ray, atol=0.1) and geometry.baseline_mm == 4


def test_masks_and_depth_of_the_source_are_undistorted_with_it():
    bent = Intrinsics(np.array([[90.0, 0, 48], [0, 90, 32], [0, 0, 1]]), np.array([-0.3, 0, 0, 0]))
    geometry, mask = geometry_of((96, 64), Calibration(bent)), np.zeros((64, 96), bool)
    mask[5:20, 10:40] = True
    assert geometry.size == (96, 64)
    shown = geometry.image(np.repeat(np.uint8(255) * mask[..., None], 3, 2))[..., 0] > 127
    assert (shown != mask).sum() > 30 and (geometry.values(mask) != shown).sum() < 10
    assert set(np.unique(geometry.values(np.where(mask, np.float32(7), np.float32(3))))) == {3, 7}


def test_a_rectangle_must_be_inside_the_image():
    with pytest.raises(InputError, match="--crop: expected a rectangle within 100x80 px, got 50,50,60,10"):
        geometry_of((100, 80), crop=(50, 50, 60, 10))
    with pytest.raises(InputError, match="--blank: expected x,y,width,height in px, got '1,2,3'"):
        parse_rectangle("1,2,3", "--blank")


def test_a_work_folder_survives_crashes(tmp_path):
    out, plan = tmp_path / "out", {"a": 1}
    with pytest.raises(KeyboardInterrupt), work_folder(out, plan) as folder:
        (folder / "images").mkdir()
        (folder / "images/000000.png").touch()
        raise KeyboardInterrupt
    with pytest.raises(RuntimeError), work_folder(out, plan) as folder:
        assert (folder / "images/000000.png").exists()
        raise RuntimeError
    with pytest.raises(InputError), work_folder(out, {"a": 2}) as folder:
        assert not (folder / "images").exists()  # another plan starts from nothing
        raise InputError("x")
    assert list(tmp_path.iterdir()) == []  # a mistake of the user leaves nothing
    with work_folder(out, plan) as folder:
        (folder / "x").touch()
    assert [path.name for path in out.iterdir()] == ["x"]
    with pytest.raises(InputError, match="expected a new or empty folder"), work_folder(out, plan):
        pass


def test_two_processes_do_not_write_one_folder(tmp_path):
    with work_folder(tmp_path / "out", {}) as folder:
        with pytest.raises(InputError, match="no other process is writing"), work_folder(tmp_path / "out", {}):
            pass
        assert folder.exists()


def test_the_last_frame_of_an_interrupted_run_is_written_again(tmp_path):
    for part, count in (("images", 4), ("masks", 3), ("depth", 3)):
        (tmp_path / part).mkdir()
        for i in range(count):
            (tmp_path / part / f"{i:06d}.png").touch()
    assert frames_done(tmp_path, ["images", "masks", "depth"]) == 2 and frames_done(tmp_path, ["images", "right"]) == 0


@pytest.mark.parametrize(
    "options", [{"end": 1.0, "start": 2.0}, {"max_frames": 1}, {"field_of_view_degrees": float("nan")}]
)
def test_impossible_options_are_errors(options):
    with pytest.raises(ValueError, match=next(iter(options)).split("_")[0]):
        PrepareConfig(**options)


@pytest.mark.parametrize("count", range(9))
def test_windows_are_centered_on_their_frame(count):
    frames = [MeasuredFrame(i, i, np.zeros((1, 1, 3), np.uint8), None, None) for i in range(count)]
    windows = [[frame.position for frame in window] for window in with_neighbors(frames)]
    reach = [min(REACH, i, count - 1 - i) for i in range(count)]
    assert windows == [list(range(i - r, i + r + 1)) for i, r in enumerate(reach)]
