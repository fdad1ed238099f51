"""Exact nearest neighbors: by hand, against all distances, invariances, threads, poison."""

import numba
import numpy as np
import pytest

from endoprior.compute.morton import curve_order
from endoprior.compute.neighbors import MAX_COORDINATE
from endoprior.training.local_motion import neighbors_numba as neighbors

NUM = 700
"""Points of a cloud."""


def surface(rng, num=NUM):
    x, y = rng.uniform(-30, 30, (2, num))
    return np.c_[x, y, 60 + 8 * np.sin(x / 9) + rng.normal(0, 0.1, num)]


def with_outliers(rng, distance):
    cloud = surface(rng)
    cloud[[5, 300, 301]] = distance * rng.normal(size=(3, 3))
    return cloud


CLOUDS = {
    "surface": surface,
    "lattice": lambda rng: rng.permuted(np.argwhere(np.ones((9, 9, 9)))[:NUM].astype(float), axis=0),  # ties everywhere
    "coincident": lambda rng: np.full((NUM, 3), 3.7),
    "two places": lambda rng: np.repeat(rng.integers(0, 2, (NUM, 1)), 3, 1) * 1.0,
    "far outliers": lambda rng: with_outliers(rng, 1e6),
    "largest": lambda rng: with_outliers(rng, 1e149),
    "tiny": lambda rng: 1e-300 * surface(rng),  # squares underflow: all distances are zero
}


def full_search(points, k):
    """All distances in float64, sorted by (distance, index)."""
    p = points.astype(np.float64)
    x, y, z = (p[:, None, a] - p[None, :, a] for a in range(3))
    square = x * x + y * y + z * z
    np.fill_diagonal(square, np.inf)
    order = np.argsort(square, 1, kind="stable")[:, :k]
    return order, np.sqrt(np.take_along_axis(square, order, 1))


def assert_exact(points, k):
    indices, distances = neighbors(points, k)
    want, want_distances = full_search(points, k)
    assert indices.dtype == np.intp and distances.dtype == np.float64
    assert np.array_equal(indices, want)
    assert np.array_equal(distances, want_distances)


def test_points_on_a_line_by_hand():
    indices, distances = neighbors(np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0]]), 2)
    assert indices.tolist() == [[1, 2], [0, 2], [1, 0], [2, 1]]
    assert distances.tolist() == [[1, 3], [1, 2], [2, 3], [4, 6]]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", CLOUDS)
def test_every_neighbor_is_found(name, dtype):
    cloud = CLOUDS[name](np.random.default_rng(0))
    if dtype == np.float32:
        cloud = cloud.clip(-1e37, 1e37)
    assert_exact(cloud.astype(dtype), 8)


@pytest.mark.parametrize("num", [2, 3, 7, 8, 9, 16, 63, 64, 65, 72, 511, 513])
def test_any_number_of_points_and_neighbors(num):
    cloud = surface(np.random.default_rng(num), num)
    for k in {1, min(8, num - 1), num - 1}:
        assert_exact(cloud, k)


def test_a_crowded_cell_of_the_curve_gets_its_own():
    rng = np.random.default_rng(1)
    cloud = surface(rng, 3000)
    cloud[0] = 1e9

    def step(points):
        order = curve_order(points)
        assert np.array_equal(np.sort(order), np.arange(len(points)))
        return np.median(np.linalg.norm(np.diff(points[order], axis=0), axis=1))

    assert step(cloud) < 1.2 * step(cloud[1:])  # without the finer curve: the order drawn, 20 times farther


def test_coincident_points_keep_their_order_on_the_curve():
    assert np.array_equal(curve_order(np.zeros((1000, 3))), np.arange(1000))


def test_renaming_and_turning_the_points_changes_nothing():
    rng = np.random.default_rng(2)
    cloud, new = surface(rng), rng.permutation(NUM)
    indices, distances = neighbors(cloud, 8)
    renamed, same = neighbors(cloud[new], 8)
    assert np.array_equal(new[renamed], indices[new])
    assert np.array_equal(same, distances[new])
    for turned in (-cloud[:, [2, 0, 1]], np.asfortranarray(cloud)):  # arrays of any layout
        assert np.array_equal(neighbors(turned, 8)[0], indices)


def test_the_number_of_threads_changes_no_bit():
    cloud, threads = CLOUDS["lattice"](np.random.default_rng(3)), numba.get_num_threads()
    results = []
    try:
        for count in (1, threads):
            numba.set_num_threads(count)
            results.append(neighbors(cloud, 8))
    finally:
        numba.set_num_threads(threads)
    for one, many in zip(*results, strict=True):
        assert np.array_equal(one, many)


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf, 10 * MAX_COORDINATE])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_is_no_place_is_an_error(poison, dtype):
    cloud = surface(np.random.default_rng(5))
    cloud[17, 1] = poison
    with pytest.raises(ValueError, match="points must be finite"), np.errstate(over="ignore"):
        neighbors(cloud.astype(dtype), 8)


@pytest.mark.parametrize(("shape", "k"), [((8, 3), 8), ((1, 3), 1), ((0, 3), 1), ((8, 3), 0), ((20, 2), 3)])
def test_too_few_points_and_points_in_the_plane_are_errors(shape, k):
    with pytest.raises(ValueError, match="number of other points" if shape[1] == 3 else "points must have shape"):
        neighbors(np.zeros(shape), k)
