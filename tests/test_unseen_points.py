"""Points where no frame shows tissue: which cells get one, its color and depth, and how it moves."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from endoprior.core.config_deformation import BasisConfig
from endoprior.core.geometry import back_project, pixel_centers, project
from endoprior.core.types import Camera, Frame
from endoprior.initialization.motion_fit import InitialMotion
from endoprior.initialization.sampling import PointCloud, concatenated
from endoprior.initialization.unseen import CELLS, convex_hull, laplace_fill, unseen_points
from endoprior.model.basis import spline_weights

WIDTH, HEIGHT = 320, 240
SIZE = WIDTH // CELLS
CAMERA = Camera(WIDTH, HEIGHT, 300.0, 300.0, 160.0, 120.0, np.eye(4))
BASIS = BasisConfig(num_bases=5)
COLOR = np.array([200, 100, 60], np.uint8)


def frame(index: int, tissue: np.ndarray, hidden_color: int = 30, hidden_depth: float = 20.0) -> Frame:
    """Tissue of one color on a slanted plane; something dark and near where there is none."""
    slope = 60 + 20 * pixel_centers(WIDTH, HEIGHT)[..., 0] / WIDTH
    depth = np.where(tissue, slope, hidden_depth).astype(np.float32)
    image = np.where(tissue[..., None], COLOR, np.uint8(hidden_color)).astype(np.uint8)
    return Frame(index, index / 4, CAMERA, image, tissue, depth, depth > 0)


def with_tool(columns: slice, rows: slice = slice(80, 160)) -> np.ndarray:
    tissue = np.ones((HEIGHT, WIDTH), bool)
    tissue[rows, columns] = False
    return tissue


def cloud_of(frames: list[Frame]) -> PointCloud:
    """Every fourth pixel of tissue."""
    parts = []
    for position, each in enumerate(frames):
        y, x = np.nonzero(each.tissue_mask)
        keep = (x % 4 == 2) & (y % 4 == 2)
        points = back_project(np.stack([x, y], -1)[keep] + 0.5, each.depth[y, x][keep], CAMERA).astype(np.float32)
        parts.append(PointCloud(points, np.zeros_like(points), np.full(len(points), position, np.int32)))
    return concatenated(parts)


def at_rest(frames: list[Frame], cloud: PointCloud) -> tuple[PointCloud, InitialMotion | None]:
    return unseen_points(frames, cloud, None, BASIS)


def test_convex_hull() -> None:
    mask = np.zeros((9, 12), bool)
    assert not convex_hull(mask).any()
    mask[2, 3] = mask[6, 3] = mask[2, 9] = mask[6, 9] = True
    want = np.zeros_like(mask)
    want[2:7, 3:10] = True
    np.testing.assert_array_equal(convex_hull(mask), want)
    y, x = np.mgrid[:101, :101]
    disk = (x - 50) ** 2 + (y - 50) ** 2 <= 45**2
    with_hole = disk & ((np.abs(x - 50) > 10) | (np.abs(y - 50) > 20))
    assert (convex_hull(with_hole) ^ disk).mean() < 0.01
    np.testing.assert_array_equal(convex_hull(np.ones((4, 5), bool)), np.ones((4, 5), bool))


def test_between_known_values_it_is_linear() -> None:
    known = np.zeros((6, 9), bool)
    known[:, [0, -1]] = True
    values = np.where(known, [0.0] * 4 + [np.nan] + [8.0] * 4, 0)[..., None]
    np.testing.assert_allclose(laplace_fill(values, known)[..., 0], np.tile(np.arange(9.0), (6, 1)), atol=1e-9)


def test_each_open_cell_is_the_mean_of_its_neighbors_and_known_ones_stay() -> None:
    rng = np.random.default_rng(0)
    known = rng.random((12, 15)) < 0.3
    values = rng.random((12, 15, 2))
    filled = laplace_fill(values, known)
    np.testing.assert_array_equal(filled[known], values[known])
    for y, x in np.argwhere(~known):
        around = [(y + 1, x), (y - 1, x), (y, x + 1), (y, x - 1)]
        around = [filled[v, u] for v, u in around if 0 <= v < 12 and 0 <= u < 15]
        np.testing.assert_allclose(filled[y, x], np.mean(around, 0), atol=1e-9)


def test_everything_and_nothing_known() -> None:
    values = np.ones((3, 4, 1))
    np.testing.assert_array_equal(laplace_fill(values, np.ones((3, 4), bool)), values)
    with pytest.raises(ValueError, match="nothing is known"):
        laplace_fill(values, np.zeros((3, 4), bool))


def test_behind_a_tool_that_stands_still_the_tissue_goes_on() -> None:
    frames = [frame(k, with_tool(slice(120, 200))) for k in range(4)]
    found, motion = at_rest(frames, cloud_of(frames))
    assert motion is None and len(found) == (80 // SIZE) ** 2
    pixels, z = project(found.points.astype(np.float64), CAMERA)
    np.testing.assert_allclose(z, 60 + 20 * pixels[:, 0] / WIDTH, rtol=0.01)
    np.testing.assert_allclose(found.colors, np.tile(COLOR / 255, (len(found), 1)), atol=1e-5)
    assert (found.origins == 0).all()


def test_what_the_tool_looks_like_does_not_matter() -> None:
    tissue = with_tool(slice(120, 200))
    usual, other = ([frame(k, tissue, *looks) for k in range(2)] for looks in ((30, 20.0), (255, 0.0)))
    clouds = [at_rest(frames, cloud_of(usual))[0] for frames in (usual, other)]
    np.testing.assert_array_equal(clouds[0].points, clouds[1].points)
    np.testing.assert_array_equal(clouds[0].colors, clouds[1].colors)


def test_what_another_frame_shows_is_not_guessed() -> None:
    frames = [frame(0, with_tool(slice(60, 120))), frame(1, with_tool(slice(200, 260)))]
    found, _ = at_rest(frames, cloud_of(frames))
    assert len(found) == 0


def test_corners_around_a_round_picture_stay_empty() -> None:
    x, y = np.moveaxis(pixel_centers(WIDTH, HEIGHT), -1, 0)
    frames = [frame(0, (x - 160) ** 2 + (y - 120) ** 2 < 100**2)]
    found, _ = at_rest(frames, cloud_of(frames))
    pixels, _ = project(found.points.astype(np.float64), CAMERA)
    assert (np.linalg.norm(pixels - (160, 120), axis=1) < 100 + 2 * SIZE).all()


def test_new_points_move_as_those_around() -> None:
    frames = [frame(k, with_tool(slice(120, 200))) for k in range(4)]
    cloud = cloud_of(frames)
    cloud = cloud.subset(cloud.origins == 0)
    rng, num = np.random.default_rng(0), len(cloud)
    coefficients, at_frames = (
        np.tile(0.1 * rng.normal(size=(1, n, 3)), (num, 1, 1)).astype(np.float32) for n in (5, 4)
    )
    given = InitialMotion(coefficients, at_frames, np.ones((num, 4), bool))
    found, motion = unseen_points(frames, cloud, given, BASIS)
    new = InitialMotion(*(part[num:] for part in (motion.coefficients, motion.at_frames, motion.followed)))
    assert len(motion.followed) == num + len(found) and not new.followed.any()
    np.testing.assert_allclose(new.coefficients, np.tile(coefficients[:1], (len(found), 1, 1)), atol=1e-6)
    np.testing.assert_allclose(new.at_frames, np.tile(at_frames[:1], (len(found), 1, 1)), atol=1e-6)
    first = (found.points + new.displacement(spline_weights(0.0, 5), 0))[found.origins == 0]
    pixels, z = project(first.astype(np.float64), CAMERA)
    np.testing.assert_allclose(z, 60 + 20 * pixels[:, 0] / WIDTH, rtol=0.01)


def test_a_frame_without_tissue_adds_nothing() -> None:
    frames = [frame(0, np.ones((HEIGHT, WIDTH), bool)), frame(1, np.zeros((HEIGHT, WIDTH), bool))]
    assert len(at_rest(frames, cloud_of(frames))[0]) == 0


def test_depth_along_the_rim_alone_is_enough() -> None:
    tissue = with_tool(slice(120, 200))
    usual = frame(0, tissue)
    one_px_around = cv2.dilate((~tissue).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    depth = np.where(one_px_around, usual.depth, 0)
    bare = Frame(0, 0.0, CAMERA, usual.rgb_u8, tissue, depth, depth > 0)
    found, _ = at_rest([bare], cloud_of([bare]))
    assert len(found) and np.isfinite(found.points).all() and (found.points[:, 2] > 0).all()
