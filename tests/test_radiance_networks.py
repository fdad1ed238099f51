"""The networks of the radiance fields: shapes, counts and first values as published, and their derivatives."""

from __future__ import annotations

import math

import pytest
import torch

from endoprior.compute.frequency_encoding import encoded, encoded_size
from endoprior_radiance import endosurf
from endoprior_radiance import presets as presets_radiance
from endoprior_radiance.endonerf import CanonicalNetwork, EndoNeRF, TimeNetwork
from endoprior_radiance.endosurf import (
    ColorNetwork,
    DeformationNetwork,
    EndoSurf,
    SurfaceNetwork,
    encoded_change,
    rounds_of,
)
from endoprior_radiance.layers import Linear, NormedLinear, start
from endoprior_radiance.presets import RadianceConfig


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def count(network: torch.nn.Module) -> int:
    return sum(each.numel() for each in network.parameters())


def points(num: int = 50, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.rand(num, 3, generator=seeded(1), dtype=dtype) * 1.4 - 0.7


def test_encoding_of_one_number():
    found = encoded(torch.tensor([[0.5]]), 2)[0].tolist()
    assert found == pytest.approx([0.5, math.sin(0.5), math.cos(0.5), math.sin(1), math.cos(1)])
    assert [encoded_size(3, 10), encoded_size(1, 10), encoded_size(3, 4)] == [63, 21, 27]
    assert encoded(points(), 10).shape == (50, 63)


def test_change_of_the_encoding_is_its_derivative():
    x, dx, step = points(5, torch.float64), points(10, torch.float64)[5:], 1e-6
    slow = (encoded(x + step * dx, 4) - encoded(x - step * dx, 4)) / (2 * step)
    torch.testing.assert_close(encoded_change(x, dx, 4), slow, rtol=1e-7, atol=1e-8)


def test_networks_have_the_published_sizes():
    assert count(TimeNetwork()) == 499_203
    assert count(CanonicalNetwork()) == 595_844
    assert count(DeformationNetwork()) == 463_518
    assert count(SurfaceNetwork()) == 549_122
    assert count(ColorNetwork()) == 642_310
    assert [layer.in_features for layer in TimeNetwork().trunk.layers] == [84, 256, 256, 256, 256, 319, 256, 256]
    assert [layer.inputs for layer in SurfaceNetwork().layers] == [39, 256, 256, 256, 295, 256, 256, 256, 256]
    assert [layer.outputs for layer in DeformationNetwork().layers] == [256, 256, 256, 204, 256, 256, 256, 256, 3]
    assert [layer.inputs for layer in ColorNetwork().layers] == [349, 256, 256, 256, 605, 256, 256, 256, 256]


def test_start_is_a_function_of_the_generator_only():
    before = torch.get_rng_state()
    a, b, c = Linear(5, 4), Linear(5, 4), Linear(5, 4)
    for layer, seed in ((a, 0), (b, 0), (c, 1)):
        layer.start(seeded(seed))
    assert torch.equal(a.weight, b.weight) and not torch.equal(a.weight, c.weight)
    assert float(a.weight.detach().abs().max()) <= 1 / math.sqrt(5)
    assert torch.equal(before, torch.get_rng_state())


def test_length_and_direction_of_rows():
    layer = NormedLinear(6, 3)
    layer.start(seeded())
    weight = layer.weight.detach().clone()
    torch.testing.assert_close(weight, layer.direction.detach())
    with torch.no_grad():
        layer.direction.mul_(7)  # only the direction of a row counts
        layer.length.mul_(2)
    torch.testing.assert_close(layer.weight, 2 * weight)


def test_nothing_is_displaced_at_time_0():
    network = TimeNetwork()
    start(network, seeded())
    assert torch.equal(network(points(), 0.0), torch.zeros(50, 3))
    assert float(network(points(), 0.5).detach().abs().max()) > 0


def test_canonical_values_are_color_and_raw_density():
    network = CanonicalNetwork()
    start(network, seeded())
    values = network(points(), torch.nn.functional.normalize(points(), dim=-1))
    assert values.shape == (50, 4)
    assert bool((values[:, :3] > 0).all()) and bool((values[:, :3] < 1).all())


@pytest.mark.parametrize("seed", range(3))
def test_surface_starts_as_a_sphere(seed: int):
    network = SurfaceNetwork()
    network.start(seeded(seed))
    rng = seeded(seed + 10)
    x = torch.nn.functional.normalize(torch.randn(400, 3, generator=rng), dim=-1) * torch.rand(400, 1, generator=rng)
    with torch.no_grad():
        distance, features = network(x)
    error = distance - (x.norm(dim=-1) - endosurf.SPHERE)
    assert features.shape == (400, 256)
    assert float(error.abs().mean()) < 0.15  # the network is random: a sphere up to some percent
    assert bool((distance[x.norm(dim=-1) < 0.3] < 0).all())


def test_deformation_carries_directions_as_it_carries_points():
    network = DeformationNetwork().double()
    network.start(seeded())
    x, along, step = points(20, torch.float64), points(40, torch.float64)[20:], 1e-7
    moved, change = network.with_change(x, 0.3, along)
    slow = (network(x + step * along, 0.3) - network(x - step * along, 0.3)) / (2 * step)
    torch.testing.assert_close(moved, network(x, 0.3))
    torch.testing.assert_close(change, slow, rtol=1e-5, atol=1e-6)


def test_field_has_the_gradient_of_its_own_distance():
    """The gradient at a point's own time, by the chain rule through the deformation, against differences."""
    field = EndoSurf(RadianceConfig()).double()
    for network in (field.deformation, field.surface, field.color):
        network.start(seeded())
    x, step = points(10, torch.float64), 1e-6
    directions = torch.nn.functional.normalize(points(20, torch.float64)[10:], dim=-1)
    found = field.probe(x, directions, 0.4)
    for axis in torch.eye(3, dtype=torch.float64):
        slow = (field.distance(x + step * axis, 0.4) - field.distance(x - step * axis, 0.4)) / (2 * step)
        torch.testing.assert_close(found.gradient @ axis, slow, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(field.distance_and_gradient(x, 0.4)[1], found.gradient)
    slope, parameters = (found.gradient * directions).sum(-1), list(field.deformation.parameters())
    torch.testing.assert_close(found.slope, slope)
    derivatives, slow = (
        torch.autograd.grad(s.square().sum(), parameters, retain_graph=True) for s in (found.slope, slope)
    )
    for k in range(len(parameters)):  # what training gets from alpha
        torch.testing.assert_close(derivatives[k], slow[k])
    assert found.color.shape == (10, 3)
    with torch.no_grad():  # as rendering does: the same, without what only training needs
        drawn = field.probe(x, directions, 0.4)
    assert drawn.gradient is None and not drawn.color.requires_grad
    for name in ("distance", "slope", "color"):
        torch.testing.assert_close(getattr(drawn, name), getattr(found, name))


def test_rates_at_given_iterations():
    assert 5e-4 * EndoNeRF.rate(0.01) == pytest.approx(5e-4 * 0.1 ** (1_000 / 250_000))
    assert 5e-4 * EndoNeRF.rate(1.0) == pytest.approx(5e-4 * 0.1**0.4)
    published = {1: 1 / 5000, 2_500: 0.5, 5_000: 1.0, 52_500: 0.525, 100_000: 0.05}
    for iteration, factor in published.items():
        assert EndoSurf.rate(iteration / 100_000) == pytest.approx(factor), iteration


def test_rounds_add_all_samples():
    assert rounds_of(32) == [8, 8, 8, 8]
    assert rounds_of(6) == [1, 1, 1, 3]


def test_configs_differ_from_the_published_ones_in_size_only():
    sized, full = presets_radiance.endonerf(), presets_radiance.endonerf_published()
    assert (sized.schedule.fine_iterations, sized.radiance.rays, sized.radiance.refine_every) == (2000, 512, 0)
    assert (full.schedule.fine_iterations, full.radiance.rays, full.radiance.refine_every) == (100_000, 2048, 4000)
    surf = presets_radiance.endosurf_published()
    assert (surf.schedule.fine_iterations, surf.radiance.rays) == (100_000, 1024)
    for cfg in (sized, full, surf, presets_radiance.endosurf()):
        assert (cfg.radiance.even_samples, cfg.radiance.more_samples, cfg.radiance.learning_rate) == (32, 32, 5e-4)
        assert cfg.schedule.coarse_iterations == 0
