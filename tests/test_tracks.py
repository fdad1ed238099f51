"""Initial motion: points tracked through synthetic frames with known motion."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import write_tiny_sequence

from endoprior.core.checks import InputError
from endoprior.core.config import Config
from endoprior.core.config_deformation import BasisConfig, DeformationConfig
from endoprior.core.geometry import back_project, bilinear, project
from endoprior.core.types import Camera, Frame
from endoprior.data import load_sequence
from endoprior.initialization import flow_tracks as tracks
from endoprior.initialization.neighbor_motion import fill_gaps, smooth_motion
from endoprior.initialization.sampling import PointCloud
from endoprior.model.basis import basis_offsets, spline_weights
from endoprior.model.ops import NUMBA
from endoprior.model.presets import preset
from endoprior.training.gaussian_trainer import GaussianTrainer

WIDTH, HEIGHT, NUM_FRAMES, DEPTH = 160, 128, 7, 50.0


def moving_frames(step_px: tuple[float, float], *, moving: slice = slice(None)) -> list[Frame]:
    """A textured plane at 50 mm that shifts by `step_px` a frame in the columns `moving` and is static elsewhere."""
    noise = np.random.default_rng(0).random((HEIGHT + 160, WIDTH + 160, 3)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 3)
    texture = (texture - texture.min()) / (texture.max() - texture.min())
    camera = Camera(WIDTH, HEIGHT, 200.0, 200.0, WIDTH / 2, HEIGHT / 2, np.eye(4))
    frames = []
    for i in range(NUM_FRAMES):
        shift = np.array([[1, 0, step_px[0] * i - 80], [0, 1, step_px[1] * i - 80]], np.float32)
        picture = cv2.warpAffine(texture, np.array([[1, 0, -80], [0, 1, -80]], np.float32), (WIDTH, HEIGHT))
        picture[:, moving] = cv2.warpAffine(texture, shift, (WIDTH, HEIGHT))[:, moving]
        depth, rgb = np.full((HEIGHT, WIDTH), DEPTH, np.float32), (255 * picture).astype(np.uint8)
        frames.append(Frame(i, i / NUM_FRAMES, camera, rgb, depth > 0, depth, depth > 0))
    return frames


def cloud_at(pixels: list[tuple[float, float]], origin: int, camera: Camera) -> PointCloud:
    """Points seen at `pixels` in frame `origin`."""
    points = back_project(np.array(pixels), np.full(len(pixels), DEPTH), camera).astype(np.float32)
    return PointCloud(points, np.zeros_like(points), np.full(len(pixels), origin, np.int32))


def followed(frames: list[Frame], cloud: PointCloud) -> np.ndarray:
    """(T, N, 2) tracks of the cloud."""
    return tracks.track_points(frames, cloud.points.astype(np.float64), cloud.origins)


@pytest.mark.parametrize("origin", [0, 3, 6])
def test_a_shifting_plane_is_tracked_both_ways(origin):
    frames = moving_frames((2.0, -1.0))
    cloud = cloud_at([(80.5, 60.5), (70.25, 70.0)], origin, frames[0].camera)
    pixels = followed(frames, cloud)
    start = project(cloud.points.astype(np.float64), frames[0].camera)[0]
    for k in range(NUM_FRAMES):
        np.testing.assert_allclose(pixels[k], start + np.array([2.0, -1.0]) * (k - origin), atol=0.15)


def test_coefficients_move_the_points_with_the_plane():
    frames = moving_frames((2.0, -1.0))
    cloud = cloud_at([(80.5, 60.5)], 3, frames[0].camera)
    cfg = BasisConfig(num_bases=7)
    motion = tracks.initial_motion(frames, cloud, cfg)
    assert motion.coefficients.shape == (1, 7, 3) and motion.at_frames.shape == (1, NUM_FRAMES, 3)
    for frame in frames:
        moved = cloud.points + motion.displacement(spline_weights(frame.time, 7), frame.index)
        expected = cloud.points + (frame.index - 3) * np.array([2.0, -1.0, 0.0]) * DEPTH / 200
        np.testing.assert_allclose(moved, expected, atol=0.2)  # mm; half a pixel is 0.125 mm


def test_static_points_get_no_motion_and_moving_points_do():
    frames = moving_frames((1.5, 0.0), moving=slice(80, None))
    cloud = cloud_at([(20.5, 60.5), (40.5, 30.5), (120.5, 64.5)], 0, frames[0].camera)
    motion = tracks.initial_motion(frames, cloud, BasisConfig(num_bases=7)).coefficients
    assert np.abs(motion[:2]).max() < 0.03  # mm
    assert np.abs(motion[2]).max() > 0.5


@pytest.mark.parametrize(("hidden", "columns"), [(range(NUM_FRAMES), 90), ((2, 3), 70)])
def test_a_track_ends_behind_the_tool_and_continues_after_it(hidden, columns):
    frames = moving_frames((4.0, 0.0))
    for k in hidden:
        frames[k].tissue_mask[:, columns:] = False
    pixels, x = followed(frames, cloud_at([(80.5, 64.5)], 0, frames[0].camera))[:, 0], 80.5 + 4 * np.arange(NUM_FRAMES)
    lost = [k in hidden and x[k] > columns for k in range(NUM_FRAMES)]
    assert np.isnan(pixels[:, 0]).tolist() == lost
    np.testing.assert_allclose(pixels[:, 0], np.where(lost, np.nan, x), atol=0.2)


def test_flow_to_a_distant_frame_does_not_drift():
    """A texture that moves by 1.3 px a frame, 24 frames: chained flow is off by more than straight flow."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).random((96, 160)).astype(np.float32), (0, 0), 2)
    noise = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)
    grays = []
    for k in range(24):
        shift = np.array([[1, 0, 1.3 * k], [0, 1, 0]], np.float32)
        moved = cv2.warpAffine(noise, shift, (160, 96), borderMode=cv2.BORDER_REFLECT)
        grays.append((moved + np.random.default_rng(k).normal(0, 4, moved.shape)).clip(0, 255).astype(np.uint8))
    neighbors = [tracks.neighbor_flows(grays, k) for k in range(23)]
    flow = tracks.anchor_flow(grays, neighbors, 0)
    assert list(flow.there) == list(range(24)) == list(flow.back)
    inside = np.s_[20:-20, 30:100]
    straight = np.abs(flow.there[23][inside] - [1.3 * 23, 0]).mean()
    chained = np.abs(sum(there.astype(np.float32) for there, _ in neighbors)[inside] - [1.3 * 23, 0]).mean()
    assert straight < 0.15 and straight < 0.5 * chained


def test_anchors_are_the_middles_of_equal_parts():
    assert tracks.anchors(1) == [0]
    assert tracks.anchors(7) == [0, 2, 4, 6]
    assert tracks.anchors(42) == [5, 15, 26, 36]


@pytest.mark.parametrize(("largest", "limit"), [(0.4, 0.25), (0.8, 0.4), (4, 0.6), (np.inf, 0.6)])
def test_the_limit_rises_where_flow_closes_badly_but_not_for_ever(largest, limit):
    errors = np.full((1, 101), np.inf) if largest == np.inf else np.linspace(0, largest, 101)[None]
    assert tracks.cycle_limit_px(errors.astype(np.float32)) == pytest.approx(limit)


def test_poor_images_lose_fewer_points_than_a_fixed_limit_would(monkeypatch):
    """In noise few points close within a quarter of a pixel, and those that close a little worse are hardly wrong."""
    frames = moving_frames((2.0, -1.0))
    rng = np.random.default_rng(0)
    noisy = [
        replace(f, rgb_u8=(f.rgb_u8 + rng.normal(0, 60, f.rgb_u8.shape)).clip(0, 255).astype(np.uint8)) for f in frames
    ]
    cloud = cloud_at([(x + 0.5, y + 0.5) for x in range(40, 120, 8) for y in range(40, 90, 8)], 3, frames[0].camera)
    start = project(cloud.points.astype(np.float64), frames[0].camera)[0]
    truth = start + np.array([2.0, -1.0]) * (np.arange(NUM_FRAMES)[:, None, None] - 3)

    def kept() -> tuple[float, float]:
        pixels = followed(noisy, cloud)
        found = np.isfinite(pixels[..., 0])
        return found.mean(), np.median(np.linalg.norm(pixels - truth, axis=-1)[found])

    adapted = kept()
    monkeypatch.setattr(tracks, "CYCLE_PX", (0.25, 0.25))
    fixed = kept()
    assert adapted[0] > 1.3 * fixed[0] and adapted[1] < 1.1 * fixed[1]  # 1.41 times the points, 1.04 times the error


def test_a_step_agrees_with_arrays():
    """Against the same rule written with `bilinear`, on rough flow of half the size, on and off the image."""
    rng = np.random.default_rng(0)
    there = rng.normal(size=(HEIGHT // 2, WIDTH // 2, 2)).astype(np.float32)
    back = (-there + rng.normal(size=there.shape) * 0.4).astype(np.float32)
    tissue_mask = rng.random((HEIGHT, WIDTH)) < 0.8
    start = rng.random((4000, 2)) * [WIDTH + 6, HEIGHT + 6] - 3
    step = 2 * bilinear(there, start / 2)
    end = start + step
    x, y = np.clip(np.floor(end).astype(int), 0, [WIDTH - 1, HEIGHT - 1]).T
    cycle_px = np.linalg.norm(step + 2 * bilinear(back, end / 2), axis=-1)
    found = ((end >= 0) & (end <= (WIDTH, HEIGHT))).all(-1) & tissue_mask[y, x]
    assert 500 < found.sum() < 3500
    got_end, got_cycle = tracks.follow(start, there, back, tissue_mask)
    np.testing.assert_allclose(got_end, end, rtol=1e-6, atol=1e-5)  # float32 flow
    np.testing.assert_allclose(got_cycle, np.where(found, cycle_px, np.inf), rtol=1e-5, atol=1e-5)


def tracked_sheet() -> np.ndarray:
    """(6, 36, 3) points of a sheet that moves by (1, 2, 0) mm a frame, without gaps."""
    y, x = np.mgrid[:6, :6].reshape(2, -1).astype(float)
    sheet = np.stack([x, y, np.full(36, 50.0)], -1)
    return sheet + np.arange(6)[:, None, None] * np.array([1.0, 2.0, 0.0])


@pytest.mark.parametrize(
    "lost",
    [
        [np.s_[1:4, 14:16]],
        [np.s_[3:, 14:16]],
        [np.s_[:2, 14:16]],
        [np.s_[2:, :12], np.s_[4:, 12:20]],  # many at once, then those that carried them
    ],
)
def test_lost_points_move_as_their_neighbors_do(lost):
    positions = tracked_sheet()
    for part in lost:
        positions[part] = np.nan
    np.testing.assert_allclose(fill_gaps(positions), tracked_sheet())


def test_gaps_close_at_both_ends_though_the_neighbors_move_otherwise():
    positions = tracked_sheet()
    positions[4:, 14] += [0.0, 0.0, 3.0]  # the point itself moved while it was hidden
    positions[1:4, 14] = np.nan
    np.testing.assert_allclose(fill_gaps(positions)[1:4, 14, 2], [50.75, 51.5, 52.25])


def test_smooth_motion_is_that_of_the_sheet_without_its_noise():
    positions = np.repeat(tracked_sheet(), 6, axis=1)  # 216 points
    origins = np.arange(216) % 6
    sources = positions[origins, np.arange(216)]
    np.testing.assert_allclose(smooth_motion(positions, origins), positions - sources, atol=1e-5)
    noise = np.random.default_rng(0).normal(0, 0.4, positions.shape)
    error = smooth_motion(positions + noise, origins) - (positions - sources)
    assert np.abs(error).mean() < 0.35 * np.abs(noise - noise[origins, np.arange(216)]).mean()


def test_smooth_motion_is_a_weighted_mean_of_displacements():
    rng = np.random.default_rng(1)
    positions, origins = rng.normal(size=(3, 9, 3)).astype(np.float32), np.full(9, 1)
    for n in range(9):
        distance = np.linalg.norm(positions[1] - positions[1, n], axis=-1)
        asked = np.argsort(distance)[::4]
        weights = np.exp(-0.5 * (distance[asked] / distance[asked].mean()) ** 2)
        expected = ((positions - positions[1])[:, asked] * weights[:, None]).sum(1) / weights.sum()
        np.testing.assert_allclose(smooth_motion(positions, origins)[:, n], expected, atol=1e-6)


def test_points_without_neighbors_stay():
    positions = np.full((6, 3, 3), np.nan)
    positions[1, 0], positions[4, 0] = 3.0, 9.0
    positions[2, 1] = 5.0
    filled = fill_gaps(positions)
    np.testing.assert_array_equal(filled[:, 0, 0], [3, 3, 3, 3, 9, 9])
    np.testing.assert_array_equal(filled[:, 1], 5)
    assert np.isnan(filled[:, 2]).all()


def test_unmeasured_depth_leaves_a_gap():
    frames = moving_frames((0.0, 0.0))
    frames[2].depth_valid[:] = False
    cloud = cloud_at([(40.5, 40.5)], 0, frames[0].camera)
    lifted = tracks.lift(frames, followed(frames, cloud))
    assert np.isnan(lifted[2]).all()
    np.testing.assert_allclose(lifted[[0, 1, 3, 4, 5, 6], 0], np.broadcast_to(cloud.points, (6, 3)), atol=0.13)


def test_frames_too_small_for_flow_get_no_motion(caplog):
    frames = moving_frames((1.0, 0.0))
    cut = ("rgb_u8", "tissue_mask", "depth", "depth_valid")
    small = [replace(f, **{name: getattr(f, name)[:16] for name in cut}) for f in frames]
    cloud = cloud_at([(8.5, 8.5)], 0, frames[0].camera)
    motion = tracks.initial_motion(small, cloud, BasisConfig(num_bases=4))
    assert motion.coefficients.shape == (1, 4, 3) and motion.at_frames.shape == (1, NUM_FRAMES, 3)
    assert not motion.coefficients.any() and not motion.at_frames.any() and "too small" in caplog.text


def test_training_starts_along_the_tracks(tmp_path):
    sequence = load_sequence(write_tiny_sequence(tmp_path / "tiny", width=96, height=80))
    cfg = preset("default")
    trainer = GaussianTrainer(sequence, replace(cfg, init=replace(cfg.init, budget=300)))
    trainer.start()
    cfg = trainer.cfg
    gaussians = trainer.state.gaussians
    assert gaussians["motion"].abs().amax() > 0.3  # mm; the plane slides by 3 mm
    assert gaussians["frame_motion"][:, sequence.indices("train")].any() and not gaussians["changes"].any()
    assert not gaussians["frame_motion"][:, sequence.indices("test")].any()  # which nothing reads
    # The points drift with the plane: most of the track's motion is theirs at every time.
    moved, still = (basis_offsets(gaussians.tensors, time, cfg, NUMBA).means.detach() for time in (0.25, 0.75))
    assert (moved - still)[:, 0].median() == pytest.approx(3.0, abs=1.0)


def test_only_the_basis_can_start_along_tracks():
    with pytest.raises(InputError, match=r"init\.motion: expected rest with deformation\.kind hexplane[;,] got flow"):
        Config(deformation=DeformationConfig(kind="hexplane"))


def test_what_stays_in_the_image_while_the_camera_moves_is_no_track():
    frames = moving_frames((-4.0, 0.0), moving=slice(60, None))  # columns before that belong to the lens
    for k, frame in enumerate(frames):
        moved = np.eye(4)
        moved[0, 3] = -4.0 * k * DEPTH / 200
        frames[k] = replace(frame, camera=replace(frame.camera, world_to_camera=moved))
    cloud = cloud_at([(30.5, 60.5), (130.5, 60.5)], 0, frames[0].camera)
    lens, tissue = followed(frames, cloud).transpose(1, 0, 2)
    assert np.isnan(lens[1:]).all()
    np.testing.assert_allclose(tissue[:, 0], 130.5 - 4 * np.arange(NUM_FRAMES), atol=0.2)
