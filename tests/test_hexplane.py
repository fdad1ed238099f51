"""HexPlane: counts, values and gradients against `grid_sample`, time mapping, determinism, and the sparse Adam."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numba
import numpy as np
import pytest
import torch
from hexplane_grids import SMALL, planes, random_grid, random_layer, random_unit, sample
from reference.hexplane import features
from torch import Tensor

from endoprior.core.config_deformation import HexPlaneConfig
from endoprior.model.hexplane import FRESH, PLANE_NAMES, TOUCHED, PlaneGrid, mapped_zeros
from endoprior.model.hexplane_numba import CHUNK, hexplane_linear
from endoprior.training.adam import PlaneAdam
from endoprior.training.adam import adam_planes_step_numba as adam_planes_step


def planes_of(grid: PlaneGrid, source: Tensor | None = None) -> list[list[Tensor]]:
    return [[grid.plane(s, name, source) for name in PLANE_NAMES] for s in range(grid.num_scales)]


@pytest.mark.parametrize(("channels", "numbers", "features"), [(64, 85_278_720, 256), (32, 42_639_360, 128)])
def test_sizes_of_the_published_presets(channels: int, numbers: int, features: int) -> None:
    grid = PlaneGrid(HexPlaneConfig(channels=channels))  # EndoNeRF and SCARED
    assert (grid.num_cells * grid.channels, grid.num_features) == (numbers, features)
    assert grid.plane(3, "xz").shape == (512, 512, channels)
    assert grid.plane(3, "zt").shape == (100, 512, channels)


def test_starting_values() -> None:
    grid = PlaneGrid(SMALL)
    grid.initialize(torch.Generator().manual_seed(3))
    for scale in planes_of(grid):
        space, times = torch.cat([p.flatten() for p in scale[:3]]), scale[3:]
        assert 0.1 <= space.min() < 0.13 and 0.47 < space.max() <= 0.5  # hundreds of draws reach near both ends
        assert all((plane == 1).all() for plane in times)
    again = PlaneGrid(SMALL)
    again.initialize(torch.Generator().manual_seed(3))
    assert torch.equal(again.values, grid.values)
    again.initialize(torch.Generator().manual_seed(4))
    assert not torch.equal(again.values, grid.values)


def test_planes_do_not_overlap_and_fill_the_storage() -> None:
    grid = PlaneGrid(SMALL)
    grid.values.zero_()
    for k, name in itertools.product(range(2), PLANE_NAMES):
        grid.plane(k, name).add_(1)
    assert (grid.values == 1).all()


def test_closed_form_at_cells_and_between() -> None:
    """Planes that are linear in their coordinates make the samples linear too, so the feature has a closed form."""
    cfg = planes((3, 4, 5), 6, 1, (1,))
    grid = PlaneGrid(cfg)
    for name in PLANE_NAMES:
        plane = grid.plane(0, name)
        rows, columns = (torch.linspace(0, 1, size) for size in plane.shape[:2])
        plane[..., 0] = 1 + columns[None, :] + 2 * rows[:, None]
    x, y, z, t = 0.3, 0.9, 0.55, 0.77
    want = np.prod([1 + a + 2 * b for a, b in [(x, y), (x, z), (y, z), (x, t), (y, t), (z, t)]])
    got = sample(grid, torch.tensor([[x, y, z]]), 2 * t - 1).item()
    assert got == pytest.approx(want, rel=2e-6)  # a dozen float32 roundings


@pytest.mark.parametrize("channels", [1, 20, 64, 100])
def test_agrees_with_grid_sample(channels: int) -> None:
    """Values and the gradients of positions and planes, some points outside the box, at three times."""
    cfg = planes((5, 4, 6), 7, channels, (1, 3))
    for seed, time in enumerate((0.0, 0.37, 0.98)):
        grid = random_grid(cfg, seed)
        unit = random_unit(150, seed, -0.2, 1.2).requires_grad_(True)
        cotangent = torch.randn(150, grid.num_features, generator=torch.Generator().manual_seed(9))
        got = sample(grid, unit, time)
        (got * cotangent).sum().backward()

        values = grid.values.double().requires_grad_(True)
        double_unit = unit.detach().double().requires_grad_(True)
        want = features(planes_of(grid, values), double_unit, time)
        (want * cotangent).sum().backward()
        # float32: six samples of four products each, around 1; a position rounds to 1e-7 of at most 17 cells.
        torch.testing.assert_close(got, want.float(), rtol=2e-5, atol=1e-6)
        # Sums over up to 200 channels and 150 Gaussians of terms up to about 20.
        torch.testing.assert_close(unit.grad, double_unit.grad.float(), rtol=1e-4, atol=2e-3)
        torch.testing.assert_close(grid.grads, values.grad.float(), rtol=1e-4, atol=1e-4)
        received = values.grad.abs().amax(-1) > 0
        assert (grid.marks[received] == TOUCHED | FRESH).all() and (grid.marks == 0).any()


@pytest.mark.parametrize("channels", [1, 20, 64])
def test_linear_layer_agrees_with_grid_sample(channels: int) -> None:
    """Values and all gradients at three times, two of them in the same row of the time planes."""
    times = (0.2, 0.25, 0.9)
    grid = random_grid(planes((5, 4, 6), 7, channels, (1, 3)))
    unit = random_unit(150, 3, -0.2, 1.2).requires_grad_(True)
    weight, bias = random_layer(grid)
    cotangents = torch.randn(3, 150, 5, generator=torch.Generator().manual_seed(9))
    got = torch.stack(hexplane_linear(grid, unit, times, weight, bias))
    (got * cotangents).sum().backward()

    exact = [tensor.detach().double().requires_grad_(True) for tensor in (grid.values, unit, weight, bias)]
    values, double_unit, double_weight, double_bias = exact
    found = [features(planes_of(grid, values), double_unit, time) for time in times]
    want = torch.stack([f @ double_weight.T + double_bias for f in found])
    (want * cotangents).sum().backward()
    torch.testing.assert_close(got, want.float(), rtol=2e-5, atol=2e-6)  # float32 means over up to 128 products
    for found, expected in zip((grid.grads, unit.grad, weight.grad, bias.grad), exact, strict=True):
        # Sums over 150 Gaussians and three times.
        torch.testing.assert_close(found, expected.grad.float(), rtol=1e-4, atol=1e-3)


def test_times_together_equal_times_apart() -> None:
    """One call for two times, over more than one chunk, is two calls; a time that nothing reads has no gradient."""
    num, times = CHUNK + 77, (0.3, 0.45)
    cotangents = torch.randn(2, num, 5, generator=torch.Generator().manual_seed(2))
    for read in ((0, 1), (0,), (1,)):
        results = []
        for calls in ((times,), tuple((time,) for time in times)):
            grid, unit = random_grid(), random_unit(num).requires_grad_(True)
            weight, bias = random_layer(grid)
            out = [made for call in calls for made in hexplane_linear(grid, unit, call, weight, bias)]
            sum((out[m] * cotangents[m]).sum() for m in read).backward()
            results.append((torch.stack(out), unit.grad, weight.grad, bias.grad, grid.grads))
        for together, apart in zip(*results, strict=True):
            # float32; sums over 2125 Gaussians of terms around 1, in another order.
            torch.testing.assert_close(together, apart, rtol=1e-4, atol=1e-3)


def test_linear_layer_is_sampling_and_a_product() -> None:
    grid, unit = random_grid(), random_unit(70)
    weight, bias = random_layer(grid)
    with torch.no_grad():
        (got,) = hexplane_linear(grid, unit, (0.6,), weight, bias)
        torch.testing.assert_close(got, sample(grid, unit, 0.6) @ weight.T + bias)
    assert not grid.marks.any()
    assert hexplane_linear(grid, unit[:0], (0.1, 0.2), weight, bias)[1].shape == (0, 5)
    for wrong in ({"weight": weight[:, 1:]}, {"bias": bias[1:]}):
        with pytest.raises(ValueError, match=next(iter(wrong)).removesuffix("s")):
            hexplane_linear(**({"grid": grid, "unit": unit, "times": (0.1,), "weight": weight, "bias": bias} | wrong))


def test_order_of_gaussians_does_not_matter() -> None:
    grid, unit = random_grid(), random_unit(300)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    assert torch.equal(sample(grid, unit[order], 0.4), sample(grid, unit, 0.4)[order])


def test_planes_begin_on_a_cache_line() -> None:
    for shape in ((3, 7), (1,), (0, 4), (1000, 64)):
        zeros = mapped_zeros(*shape)
        assert zeros.shape == shape and zeros.is_contiguous() and not zeros.any() and zeros.data_ptr() % 64 == 0
    adam = PlaneAdam(random_grid(), 1e-15)
    assert all(t.data_ptr() % 64 == 0 for t in (adam.grid.values, adam.grid.grads, adam.exp_avg, adam.exp_avg_sq))


def test_many_chunks_agree_with_grid_sample() -> None:
    """More Gaussians than one task holds, and a count that is no multiple of it."""
    grid, unit = random_grid(), random_unit(1003)
    want = features(planes_of(grid), unit, 0.5)
    torch.testing.assert_close(sample(grid, unit, 0.5), want, rtol=5e-5, atol=1e-6)  # both float32


def test_outside_the_box_is_the_border_without_gradient() -> None:
    grid = random_grid()
    outside = torch.tensor([[-0.4, 0.3, 0.6], [0.2, 1.7, 0.6], [0.2, 0.3, 1.0]], requires_grad=True)
    feature = sample(grid, outside, 0.2)
    assert torch.equal(feature, sample(grid, outside.detach().clamp(0, 1), 0.2))
    feature.sum().backward()
    assert torch.equal(outside.grad == 0, torch.eye(3, dtype=torch.bool))


def test_time_uses_half_of_the_planes() -> None:
    grid = random_grid(planes((2, 2, 2), 11, 4, (1,)))
    for time in np.arange(64) / 64:
        sample(grid, random_unit(20), float(time)).sum().backward()
    used = grid.plane(0, "xt", grid.marks[:, None]).amax((1, 2)).nonzero()[:, 0].tolist()
    assert used == list(range(5, 11))
    grid = random_grid()  # 7 rows
    assert grid.time_row(0.0) == (3, 0) and grid.time_row(1.0) == (5, 1)


def test_gradients_accumulate_over_calls_of_any_size() -> None:
    grid = random_grid()
    total = torch.zeros_like(grid.grads)
    for num, time in ((30, 0.1), (0, 0.5), (7, 0.8)):
        alone = random_grid()
        sample(alone, random_unit(num), time).sum().backward()
        total += alone.grads
        sample(grid, random_unit(num), time).sum().backward()
    torch.testing.assert_close(grid.grads, total, rtol=1e-6, atol=1e-5)  # another order of the same sums
    grid.clear_grads()
    assert not grid.grads.any() and set(grid.marks.unique().tolist()) == {0, TOUCHED}


def test_no_gaussians() -> None:
    grid = random_grid()
    nothing = torch.zeros(0, 3, requires_grad=True)
    feature = sample(grid, nothing, 0.5)
    feature.sum().backward()
    assert feature.shape == (0, grid.num_features) and nothing.grad.shape == (0, 3) and not grid.marks.any()


def test_rendering_without_gradients_leaves_no_trace() -> None:
    grid, unit = random_grid(), random_unit(40)
    with torch.no_grad():
        feature = sample(grid, unit, 0.3)
        subset = sample(grid, unit[[5, 17]], 0.3)
    assert not feature.requires_grad and torch.equal(subset, feature[[5, 17]])
    assert not grid.marks.any() and not grid.grads.any()
    assert sample(grid, unit, 0.3).requires_grad  # planes train even where positions do not


def test_a_nan_position_shows_and_stays_alone() -> None:
    grid, unit = random_grid(), random_unit(5)
    poisoned = unit.clone()
    poisoned[2, 1] = float("nan")
    clean, got = sample(grid, unit, 0.3), sample(grid, poisoned, 0.3)
    assert got[2].isnan().all()
    others = [0, 1, 3, 4]
    assert torch.equal(got[others], clean[others])
    far = sample(grid, torch.tensor([[float("inf"), -float("inf"), 1e30]]), 0.3)
    assert torch.equal(far, sample(grid, torch.tensor([[1.0, 0.0, 1.0]]), 0.3))


def test_division_of_labor_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """With more threads a task takes fewer channels: here all 40, 32 or 16 of them, whatever this machine has."""
    results = []
    for threads in (1, 2, 64):
        monkeypatch.setattr(numba, "get_num_threads", lambda threads=threads: threads)
        grid, unit = random_grid(planes((5, 4, 6), 7, 40, (1, 3))), random_unit(400).requires_grad_(True)
        weight, bias = random_layer(grid)
        sum(made.square().sum() for made in hexplane_linear(grid, unit, (0.1, 0.4), weight, bias)).backward()
        results.append((unit.grad, weight.grad, grid.grads))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_thread_count_changes_no_bit() -> None:
    results = []
    threads = numba.get_num_threads()
    try:
        for count in (1, threads, numba.config.NUMBA_NUM_THREADS, 1):
            numba.set_num_threads(count)
            grid = random_grid()
            adam = PlaneAdam(grid, 1e-15)
            for step in range(3):
                unit = random_unit(700, step).requires_grad_(True)
                feature = sample(grid, unit, step / 3)
                feature.square().sum().backward()
                made = hexplane_linear(grid, unit, (step / 3, step / 4), *random_layer(grid))
                sum(m.square().sum() for m in made).backward()
                kept = (feature.detach(), made[1].detach(), unit.grad, grid.grads.clone())
                adam_planes_step(adam, 1e-2)
            results.append((*kept, grid.values))
    finally:
        numba.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def step_cells(values, grads, exp_avg, exp_avg_sq, marks, step: int, rate: float, epsilon: float) -> None:
    """Step number `step` of cells on their own."""
    grid = SimpleNamespace(values=values, grads=grads, marks=marks)
    moments = {"exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}
    adam_planes_step(SimpleNamespace(grid=grid, steps=torch.tensor(step - 1), epsilon=epsilon, **moments), rate)


def test_adam_equals_dense_adam() -> None:
    """Twelve steps in which touched cells come and go: torch's numbers, and bit for bit those of our dense run."""
    generator = torch.Generator().manual_seed(5)
    rows, channels = 500, 10
    values = torch.rand(rows, channels, generator=generator)
    dense = values.clone().requires_grad_(True)
    torch_adam = torch.optim.Adam([dense], lr=0.01, betas=(0.9, 0.999), eps=1e-15, foreach=False)
    buffers = {kind: [values.clone(), *(torch.zeros_like(values) for _ in range(3))] for kind in ("sparse", "full")}
    marks = torch.zeros(rows, dtype=torch.uint8)
    for step in range(1, 13):
        grad = torch.randn(rows, channels, generator=generator) * 10.0 ** -(step % 7)
        hit = torch.rand(rows, generator=generator) < 0.1
        grad[~hit] = 0
        marks[hit] = TOUCHED | FRESH
        dense.grad = grad.clone()
        torch_adam.step()
        lr = 0.01
        for kind, kind_marks in (("sparse", marks), ("full", torch.full_like(marks, TOUCHED | FRESH))):
            buffers[kind][1].copy_(grad)
            step_cells(*buffers[kind], kind_marks, step, lr, 1e-15)
        assert not buffers["sparse"][1].any() and not (marks & FRESH).any()
    assert 0 < (marks == 0).sum() < rows
    untouched = marks == 0
    assert torch.equal(buffers["sparse"][0][untouched], values[untouched])
    assert all(torch.equal(a, b) for a, b in zip(buffers["sparse"], buffers["full"], strict=True))
    # Twelve float32 steps of at most about lr each, whose factors round differently in the last bit.
    torch.testing.assert_close(buffers["sparse"][0], dense.detach(), rtol=0, atol=1e-6)


def test_adam_by_its_definition() -> None:
    """Two steps of one number by hand: g = 1, then 0. m = 0.1, 0.09; v = 1e-3, 0.999e-3."""
    values, grads, m, v = torch.tensor([[2.0]]), torch.tensor([[1.0]]), torch.zeros(1, 1), torch.zeros(1, 1)
    marks = torch.tensor([TOUCHED | FRESH], dtype=torch.uint8)
    step_cells(values, grads, m, v, marks, 1, 0.5, 1e-15)
    assert values.item() == pytest.approx(1.5)  # the first step is lr * sign(g)
    step_cells(values, grads, m, v, marks, 2, 0.5, 1e-15)
    second = 0.5 * (0.09 / 0.19) / np.sqrt(0.999e-3 / (1 - 0.999**2))
    assert values.item() == pytest.approx(1.5 - second, rel=1e-6)


def test_adam_drops_moments_below_the_normal_range() -> None:
    values, grads, v = torch.ones(2, 3), torch.zeros(2, 3), torch.full((2, 3), 1e-8)
    m, marks = torch.full((2, 3), 1e-39), torch.tensor([TOUCHED, TOUCHED | FRESH], dtype=torch.uint8)
    step_cells(values, grads, m, v, marks, 900, 0.01, 1e-15)
    assert not m.any() and (values == 1).all()


def test_adam_state_resumes_bit_for_bit() -> None:
    def steps(adam: PlaneAdam, which: range) -> None:
        for k in which:
            sample(adam.grid, random_unit(50, k), k / 10).square().sum().backward()
            adam_planes_step(adam, 1e-2)

    straight = PlaneAdam(random_grid(), 1e-15)
    steps(straight, range(6))
    first = PlaneAdam(random_grid(), 1e-15)
    steps(first, range(3))
    second = PlaneAdam(random_grid(seed=8), 1e-15)
    second.grid.values.copy_(first.grid.values)
    sample(second.grid, random_unit(9), 0.9).sum().backward()  # a gradient in flight must not survive
    second.load({name: array.clone() for name, array in first.arrays().items()})
    steps(second, range(3, 6))
    assert torch.equal(second.grid.values, straight.grid.values) and second.steps == 6


@pytest.mark.parametrize(
    "change",
    [
        {"channels": 0},
        {"channels": 257},
        {"multires": ()},
        {"time_resolution": 1},
        {"multires": (1000,)},  # of which there would be 1 TB
    ],
)
def test_impossible_grids_are_refused(change: dict) -> None:
    with pytest.raises(ValueError, match="must be in"):
        HexPlaneConfig(**change)


def test_bad_calls_are_refused() -> None:
    grid = random_grid()
    with pytest.raises(ValueError, match="unit"):
        sample(grid, torch.zeros(4, 2), 0.5)
