"""Depth from the motion of a camera: each step in closed form or by a slow loop, then whole, on a known relief."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import write_tiny_sequence
from relief import HEIGHT, MATRIX, WIDTH, camera, path, pose, reader, view

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.core.geometry import back_project, project
from endoprior.core.types import Camera, Frame
from endoprior.data import load_sequence
from endoprior.data.files import CONFIDENCE
from endoprior.data.pixels import measured_share
from endoprior.initialization.sampling import GUESSED, pixel_probability
from endoprior.model.presets import preset
from endoprior.prepare import PrepareConfig, prepare
from endoprior.prepare.camera_path.views import (
    MAX_DEGREES,
    MIN_DEGREES,
    HighPassImage,
    Warp,
    choose_partners,
    matrix_at,
    parallax,
    scaled_size,
)
from endoprior.prepare.frames import WORK
from endoprior.prepare.parallax import bent, checked, measure_depth
from endoprior.prepare.plane_sweep import DIRECTIONS, aggregated, correlation, peak
from endoprior.training.frames import TrainingFrames

SIZE = (WIDTH, HEIGHT)
CENTERED = MATRIX - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # the left-most pixel at 0


def sideways(count, step_mm):
    """(count, 4, 4) world to camera of one that moves to the right."""
    return np.stack([np.linalg.inv(pose((0, 0, 0), (i * step_mm, 0, 0))) for i in range(count)])


def partners_of(poses, distance=80.0, usable=None):
    count = len(poses)
    usable = np.ones(count, bool) if usable is None else usable
    return choose_partners(poses, CENTERED, SIZE, np.full(count, distance), usable)


# ---- which frames


def test_parallax_is_the_angle_between_the_rays():
    degrees = parallax(sideways(3, 5.0), 0, [1, 2], CENTERED, SIZE, 80.0)
    # The probed points lie up to 0.6 of half the image off the axis; a third of them lies on it.
    assert degrees[0] == pytest.approx(np.degrees(np.arctan(5 / 80)), rel=0.15)
    assert degrees[1] == pytest.approx(2 * degrees[0], rel=0.05)


def test_partners_lie_on_both_sides_soon_and_with_parallax():
    poses = sideways(40, 1.0)
    partners = partners_of(poses)
    for i, found in enumerate(partners):
        degrees = parallax(poses, i, found, CENTERED, SIZE, 80.0)
        assert ((degrees >= MIN_DEGREES) & (degrees <= MAX_DEGREES)).all() and len(set(found)) == len(found) <= 4
    assert {np.sign(j - 20) for j in partners[20]} == {-1, 1} and len(partners[20]) == 4
    assert max(abs(j - 20) for j in partners[20]) <= 10  # 5 degrees at 80 mm are 7 mm
    assert all(j > 0 for j in partners[0])


@pytest.mark.parametrize("motion", ["rests", "turns", "jumps"])
def test_no_partner_without_parallax(motion):
    places = {
        "rests": [((0, 0, 0), (0, 0, 0))] * 12,
        "turns": [((0, 0.02 * i, 0), (0, 0, 0)) for i in range(12)],
        "jumps": [((0, 0, 0), (300.0 * i, 0, 0)) for i in range(12)],
    }
    assert not any(partners_of(np.stack([np.linalg.inv(pose(*each)) for each in places[motion]])))


def test_a_camera_that_drives_ahead_has_partners_and_frames_without_a_pose_are_none():
    ahead = np.stack([np.linalg.inv(pose((0, 0, 0), (0, 0, 2.0 * i))) for i in range(30)])
    assert all(partners_of(ahead)[5:-5])
    usable = np.arange(30) % 3 > 0
    found = partners_of(ahead, usable=usable)
    assert not any(found[i] for i in range(0, 30, 3)) and all(usable[j] for each in found for j in each)


# ---- where the partner sees a pixel


def test_a_warp_is_back_projection_and_projection():
    first, second = (Camera(WIDTH, HEIGHT, *MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]], np.linalg.inv(each)) for each in (
        pose((0.1, -0.2, 0.05), (3, 1, -2)), pose((-0.05, 0.1, 0), (-4, 2, 1))
    ))  # fmt: skip
    depth = 60 + 30 * np.random.default_rng(0).random((HEIGHT, WIDTH))
    x, y, inverse = Warp.between(CENTERED, first.world_to_camera, second.world_to_camera, SIZE).at(
        (1 / depth).astype(np.float32)
    )
    rows, columns = np.indices(depth.shape)
    pixels, z = project(back_project(np.stack([columns, rows], -1) + 0.5, depth, first), second)
    assert np.allclose(np.stack([x, y], -1) + 0.5, pixels, atol=2e-3) and np.allclose(1 / inverse, z, rtol=1e-4)


def test_the_matrix_of_a_smaller_image_sees_the_same_rays():
    small = matrix_at(CENTERED, SIZE, (80, 60))
    center = np.linalg.inv(small) @ [39.5, 29.5, 1]  # the middle of the image
    assert np.allclose(center, np.linalg.inv(CENTERED) @ [79.5, 59.5, 1])
    assert scaled_size((640, 512), 256) == (256, 205) and scaled_size((100, 50), 256) == (100, 50)


# ---- what is alike


def alike(view, *others, window_px=7):
    """`correlation` with views that lie pixel on pixel."""
    rows, columns = np.indices(view.detail.shape).astype(np.float32)
    same = Warp(np.stack([columns, rows, np.ones_like(rows)]), np.zeros(3, np.float32))
    return correlation(view, others, [same] * len(others), np.float32(1), window_px)


def test_correlation_bears_changes_of_light_and_leaves_out_what_is_not_seen():
    rng = np.random.default_rng(0)
    detail = cv2.GaussianBlur(rng.normal(size=(40, 50)).astype(np.float32), (0, 0), 1.5)
    seen, other = np.ones_like(detail), rng.normal(size=detail.shape).astype(np.float32)
    inner = np.s_[5:-5, 5:-5]
    assert alike(HighPassImage(detail, seen), HighPassImage(3 * detail + 0.2, seen))[inner].min() > 0.97
    assert alike(HighPassImage(detail, seen), HighPassImage(-detail, seen))[inner].max() < -0.9
    assert abs(alike(HighPassImage(detail, seen), HighPassImage(other, seen), window_px=9)[inner].mean()) < 0.1
    hidden = seen.copy()
    hidden[:, 25:] = 0
    found = alike(HighPassImage(detail, seen), HighPassImage(detail, hidden))
    assert (found[5:-5, 30:] == -1).all() and found[5:-5, 5:20].min() > 0.97


def test_correlation_is_that_of_a_slow_loop():
    rng = np.random.default_rng(1)
    (a, b), (u, v) = rng.normal(size=(2, 20, 24)).astype(np.float32), (rng.random((2, 20, 24)) > 0.2)
    found = alike(HighPassImage(a * u, u.astype(np.float32)), HighPassImage(b * v, v.astype(np.float32)), window_px=5)
    for y in range(20):
        for x in range(24):
            window = np.s_[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
            both = (u & v)[window]
            want = np.corrcoef(a[window][both], b[window][both])[0, 1] if both.sum() > 0.6 * 25 else -1
            assert found[y, x] == pytest.approx(want, abs=1e-4)


def test_of_the_partners_the_better_half_counts():
    rng = np.random.default_rng(2)
    detail, seen = rng.normal(size=(5, 12, 12)).astype(np.float32), np.ones((12, 12), np.float32)
    views = [HighPassImage(each, seen) for each in detail]
    each = np.sort([alike(views[0], other) for other in views[1:]], 0)
    assert np.allclose(alike(*views), each[2:].mean(0), atol=1e-6)
    assert np.allclose(alike(*views[:4]), np.sort([alike(views[0], other) for other in views[1:4]], 0)[1:].mean(0))
    assert np.allclose(alike(*views[:3]), np.maximum(*(alike(views[0], other) for other in views[1:3])))


def test_correlation_looks_where_the_warp_points():
    wide = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(30, 60)).astype(np.float32), (0, 0), 1.5)
    here, there = (HighPassImage(wide[:, k : k + 40].copy(), np.ones((30, 40), np.float32)) for k in (10, 5))
    rows, columns = np.indices((30, 40)).astype(np.float32)
    by_depth = Warp(np.stack([columns, rows, np.ones_like(rows)]), np.array([50, 0, 0], np.float32))  # 5 px at w = 0.1
    found = correlation(here, [there], [by_depth], np.float32(0.1), 7)
    assert found[4:-4, 4:30].min() > 0.97 and (found[:, 38:] == -1).all()
    assert correlation(here, [there], [by_depth], np.float32(0.05), 7)[4:-4, 4:30].mean() < 0.6


def test_a_view_has_no_shading_and_no_highlights():
    seen = view(path(1)[0])
    lit = np.linspace(0.35, 1.0, WIDTH)[None, :, None]
    plain, shaded = (
        HighPassImage.of((seen.rgb_u8 * light).astype(np.uint8), seen.tissue_mask, SIZE) for light in (1.0, lit)
    )
    both = (plain.usable > 0) & (shaded.usable > 0)
    assert np.corrcoef(plain.detail[both], shaded.detail[both])[0, 1] > 0.95
    glossy = seen.rgb_u8.copy()
    glossy[40:50, 60:70] = 255
    assert not HighPassImage.of(glossy, seen.tissue_mask, SIZE).usable[40:50, 60:70].any()


def test_a_peak_lies_between_planes():
    planes = np.arange(7, dtype=np.float32)[:, None, None]
    place, score = peak(1 - (planes - np.array([[2.3, 4.75, 0.0]], np.float32)) ** 2)
    assert np.allclose(place, [[2.3, 4.75, 0.0]], atol=1e-5) and score.max() <= 1


# ---- the surface


def slow_aggregation(costs, step, jump):
    height, width, planes = costs.shape
    total = np.zeros_like(costs)
    for dy, dx in DIRECTIONS:
        found = {}
        rows = range(height) if dy >= 0 else range(height - 1, -1, -1)
        columns = range(width) if dx >= 0 else range(width - 1, -1, -1)
        for y in rows:
            for x in columns:
                before = found.get((y - dy, x - dx))
                here = costs[y, x].copy()
                if before is not None:
                    for d in range(planes):
                        near = [before[e] + step for e in (d - 1, d + 1) if 0 <= e < planes]
                        here[d] += min([before[d], before.min() + jump, *near]) - before.min()
                found[y, x] = here
                total[y, x] += here
    return total / len(DIRECTIONS)


def test_semi_global_matching_is_that_of_a_slow_loop():
    costs = np.random.default_rng(0).random((6, 7, 5)).astype(np.float32)
    assert np.allclose(aggregated(costs, 0.1, 0.4), slow_aggregation(costs, 0.1, 0.4), atol=1e-5)
    assert np.allclose(aggregated(costs, 0.0, 0.0), costs, atol=1e-5)


def test_it_fills_what_has_no_texture_from_its_neighborhood():
    costs = np.ones((20, 20, 8), np.float32)
    costs[..., 3] = 0
    costs[6:14, 6:14] = 0.5  # any plane is as good
    assert (aggregated(costs, 0.1, 0.6).argmin(2) == 3).all()


# ---- how sure


def test_confidence_falls_where_partners_see_another_surface():
    poses, inverse = sideways(3, 20.0), np.full((HEIGHT, WIDTH), 1 / 80, np.float32)
    warps = [Warp.between(CENTERED, poses[1], poses[j], SIZE) for j in (0, 2)]
    score = np.full_like(inverse, 0.9)
    other = inverse.copy()
    other[:60] *= 1.1
    fused, sure = checked(inverse, score, warps, [inverse, inverse])
    _, unsure = checked(inverse, score, warps, [other, other])
    _, half = checked(inverse, score, warps, [inverse, other])
    middle = np.s_[:, 50:-50]
    assert np.allclose(fused[middle], inverse[middle]) and sure[middle].min() > 0.7
    assert unsure[:40, 50:-50].max() < 0.1 and unsure[80:, 50:-50].min() > 0.7
    assert 0.2 < half[10:40, 55:-55].mean() < 0.6 * sure[middle].mean()
    _, faint = checked(inverse, score, [Warp.between(CENTERED, poses[1], poses[1], SIZE)] * 2, [inverse, inverse])
    assert faint.max() < 0.01  # without parallax, nothing is measured


def test_a_guess_is_bent_to_what_is_measured_and_stays_where_nothing_is():
    rows, columns = np.indices((96, 128)).astype(np.float32)
    true = 80 + 10 * np.sin(columns / 20) + 5 * np.cos(rows / 30)
    guess = (true * (0.7 + 0.2 * rows / 96)).astype(np.float32)
    confidence = np.where(columns < 100, 0.9, 0).astype(np.float32)
    factor = bent(guess, 1 / true, confidence)
    assert np.abs(guess * factor / true - 1)[5:-5, :90].max() < 0.02
    assert np.abs(guess * factor / true - 1)[:, 105:].mean() < 0.04  # 0.2 before
    assert np.allclose(bent(guess, 1 / true, np.zeros_like(true)), 1)
    wrong = np.where((rows - 50) ** 2 + (columns - 50) ** 2 < 9, 8 * true, true)  # a match by chance, hardly sure
    assert (
        np.abs(bent(guess, 1 / wrong, np.where(wrong > true, 0.08, confidence).astype(np.float32)) / factor - 1).max()
        < 0.05
    )


# ---- whole


def errors(found, frames, index, guess=80.0):
    """Relative error (H, W) of the filled depth of a frame after one factor for all."""
    depth = found.depth(index, np.full((HEIGHT, WIDTH), guess, np.float32))
    return np.abs(depth / frames[index].depth - 1)


def measured(tmp_path, frames, poses):
    flat = [replace(frame, depth=np.full((HEIGHT, WIDTH), 80, np.float32)) for frame in frames]
    return measure_depth(reader(flat), camera(), poses, np.ones(len(frames), bool), tmp_path)


def test_a_relief_is_measured_from_a_known_path(tmp_path):
    camera_to_world = path(12, speed=1.5)
    frames = [view(each) for each in camera_to_world]
    found = measured(tmp_path, frames, np.linalg.inv(camera_to_world))
    assert found.doubt == "" and found.frames == 1 and found.share > 0.6
    error, sure = errors(found, frames, 6), found.confidence_of(6, SIZE) / 255
    assert np.median(error) < 0.01 and np.median(error[sure > 0.5]) < 0.006
    assert np.median(np.abs(80 / frames[6].depth - 1)) > 0.03  # what the guess had


def test_what_moves_by_itself_is_not_sure(tmp_path):
    camera_to_world, rng = path(12, speed=1.5), np.random.default_rng(0)
    frames = []
    for each in camera_to_world:
        shift = rng.normal(0, 2.5, 2)
        region = lambda x, y, shift=shift: np.where(((x - 8) ** 2 + y**2 < 18**2)[..., None], shift, 0.0)  # noqa: E731
        frames.append(view(each, move=region))
    found = measured(tmp_path, frames, np.linalg.inv(camera_to_world))
    sure = found.confidence_of(6, SIZE) / 255
    spot, _ = project(
        np.array([8.0, 0, 80]), Camera(WIDTH, HEIGHT, 150, 150, 80, 60, np.linalg.inv(camera_to_world[6]))
    )
    x, y = spot.astype(int)
    assert sure[y - 10 : y + 10, x - 10 : x + 10].mean() < 0.15 < 0.4 < sure[:20].mean()


def test_what_is_burned_into_the_image_is_not_infinitely_far(tmp_path):
    camera_to_world = path(12, speed=1.5)
    frames, logo = [view(each) for each in camera_to_world], view(path(40)[30]).rgb_u8[:40, :60]
    for frame in frames:
        frame.rgb_u8[40:80, 50:110] = logo
    found = measured(tmp_path, frames, np.linalg.inv(camera_to_world))
    assert found.confidence_of(6, SIZE)[48:72, 58:102].max() <= 1
    assert np.median(errors(found, frames, 6)[48:72, 58:102]) < 0.1


def test_a_camera_that_rests_tells_nothing(tmp_path):
    frames = [view(path(1)[0])] * 6
    found = measured(tmp_path, frames, np.tile(np.eye(4), (6, 1, 1)))
    assert "moves too little" in found.doubt and found.share == 0 and not found.confidence.any()


# ---- what training makes of it


def test_first_gaussians_start_where_depth_was_measured():
    rng, confidence = np.random.default_rng(0), np.zeros((40, 60), np.float32)
    confidence[:, 30:] = 1
    rgb_u8 = np.tile(rng.integers(60, 180, (40, 30, 3), np.uint8), (1, 2, 1))
    every = np.ones((40, 60), bool)
    camera = Camera(60, 40, 50, 50, 30, 20, np.eye(4))
    frame = Frame(0, 0.0, camera, rgb_u8, every, np.full((40, 60), 70, np.float32), every, depth_confidence=confidence)
    init = preset("default").init
    plain, weighted = (pixel_probability(each, init) for each in (replace(frame, depth_confidence=None), frame))
    assert np.allclose(weighted[:, 30:], plain[:, 30:]) and np.allclose(weighted[:, :30], GUESSED * plain[:, :30])


# ---- in a folder


def prepared(tmp_path, frames, **options):
    """The notes and the folder of frames (H, W, 3) prepared as one eye."""
    (tmp_path / "video").mkdir(exist_ok=True)
    for i, rgb_u8 in enumerate(frames):
        cv2.imwrite(str(tmp_path / f"video/{i:03d}.png"), rgb_u8[..., ::-1])
    done = prepare(tmp_path / "video", tmp_path / "out", PrepareConfig(masks="none", **options))
    return done.notes, done.out


@pytest.mark.slow
def test_prepare_measures_the_depth_of_a_moving_camera(tmp_path):
    truth = [view(each) for each in path(16, speed=1.5)]
    notes, out = prepared(tmp_path, [each.rgb_u8 for each in truth], poses="own", depth="motion")
    assert any("parallax on" in note and "filled by shading" in note for note in notes)
    sequence = load_sequence(out)
    assert "parallax" in sequence.sources["depth"] and not (out / WORK).exists()
    frame, true = sequence.frame(8), truth[8].depth
    assert np.corrcoef(np.log(frame.depth).ravel(), np.log(true).ravel())[0, 1] > 0.8
    assert frame.depth_confidence.mean() > 0.4 and measured_share([frame]) > 0.5
    literal = load_sequence(out, DataConfig(reliability="ignored"))
    assert literal.frame(8).depth_confidence is None


def test_motion_that_tells_nothing_is_an_error_and_leaves_nothing(tmp_path):
    frames = [view(path(1)[0]).rgb_u8] * 5
    with pytest.raises(InputError, match=r"expected a camera whose motion tells the depth, got .*--depth shading"):
        prepared(tmp_path, frames, poses="still", depth="motion")
    assert not (tmp_path / "out").exists()
    _, out = prepared(tmp_path, frames, poses="still")
    assert not (out / CONFIDENCE).exists() and load_sequence(out).sources["depth"] == "shading"


@pytest.mark.parametrize("filler", ["none", "auto", "sgbm"])
def test_what_fills_measured_depth_must_be_relative(tmp_path, filler):
    frames = [view(path(1)[0]).rgb_u8] * 3
    if filler == "auto":  # of one eye: shading, but nothing moves
        with pytest.raises(InputError, match="motion tells the depth"):
            prepared(tmp_path, frames, poses="still", depth="motion:auto")
    else:
        with pytest.raises(InputError, match="expected relative depth after"):
            prepared(tmp_path, frames, poses="still", depth=f"motion:{filler}")
    assert [entry.name for entry in tmp_path.iterdir()] == ["video"]


def test_confidence_is_read_shrunk_and_weighs_the_depth(tmp_path):
    write_tiny_sequence(tmp_path / "data")
    names = sorted(file.name for file in (tmp_path / "data/images").iterdir())
    height, width = cv2.imread(str(tmp_path / "data/images" / names[0])).shape[:2]
    (tmp_path / "data" / CONFIDENCE).mkdir()
    stored = np.zeros((height, width), np.uint8)
    stored[:, ::2] = 255
    for name in names:
        cv2.imwrite(str(tmp_path / "data" / CONFIDENCE / name), stored)
    sequence = load_sequence(tmp_path / "data")
    assert (sequence.frame(0).depth_confidence == stored / 255).all()
    assert (load_sequence(tmp_path / "data", DataConfig(shrink=2)).frame(0).depth_confidence == 0.5).all()
    counted = TrainingFrames(sequence).frame(0).counted_depth.numpy()
    assert set(np.unique(counted)) <= {0, np.float32(GUESSED), 1} and (counted == GUESSED).any()
    (tmp_path / "data" / CONFIDENCE / names[0]).unlink()
    with pytest.raises(InputError, match=CONFIDENCE):
        load_sequence(tmp_path / "data").frame(0)
