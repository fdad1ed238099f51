"""The order of Gaussians along the Z-curve: by hand, by literal bits, and what it is for."""

import itertools

import numpy as np

from endoprior.compute.morton import morton_order


def test_corners_of_a_cube_are_visited_x_first():
    corners = np.array([(x, y, z) for z, y, x in itertools.product((-1.0, 1.0), repeat=3)])
    shuffled = np.random.default_rng(0).permutation(8)
    assert np.array_equal(corners[shuffled][morton_order(corners[shuffled])], corners)


def test_order_is_that_of_the_interleaved_bits():
    points = np.random.default_rng(1).integers(0, 64, (200, 3))
    points[:2] = [[0, 0, 0], [64, 64, 64]]  # a box of whole cells: 6 bits of each coordinate decide

    def interleaved(point):
        x, y, z = (f"{min(int(v), 63):06b}" for v in point)
        return "".join(z[i] + y[i] + x[i] for i in range(6))

    want = sorted(range(200), key=lambda i: interleaved(points[i]))  # stable, like ours
    order = morton_order(points)
    assert [interleaved(points[i]) for i in order] == [interleaved(points[i]) for i in want]
    assert sorted(order) == list(range(200))


def test_points_in_one_place_keep_their_order():
    points = np.repeat(np.random.default_rng(2).normal(size=(5, 3)), 4, axis=0)
    blocks = morton_order(points).reshape(5, 4)
    assert (np.diff(blocks, axis=1) == 1).all()
    assert np.array_equal(morton_order(np.ones((7, 3))), np.arange(7))


def test_neighbors_in_order_are_neighbors_in_space():
    points = np.random.default_rng(3).random((5000, 3)).astype(np.float32) * [60, 50, 1]
    step = np.linalg.norm(np.diff(points[morton_order(points)], axis=0), axis=1)
    shuffled = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert np.median(step) < 0.15 * np.median(shuffled)


def test_odd_input():
    assert morton_order(np.zeros((0, 3))).shape == (0,)
    points = np.random.default_rng(4).normal(size=(30, 3))
    points[3], points[4, 1], points[5, 1:] = np.nan, np.inf, -np.inf
    assert sorted(morton_order(points)) == list(range(30))
