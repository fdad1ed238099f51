"""Offsets at one time: the HexPlane field with its box and heads, and the temporal basis."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hexplane_grids import planes
from reference import basis as reference_basis
from reference.hexplane import displacement
from safetensors.torch import load_file, save_file
from torch import Tensor

from endoprior.core.checks import InputError
from endoprior.core.config import Config
from endoprior.core.config_deformation import BasisConfig, DeformationConfig
from endoprior.model.basis import basis_offsets, basis_weights, frame_weights, spline_weights
from endoprior.model.gaussians import Offsets, change_layout, temporal_shapes
from endoprior.model.hexplane_field import HexPlaneField, OffsetHeads, box_of_points, head_shapes
from endoprior.model.ops import NUMBA

SMALL = DeformationConfig(kind="hexplane", hexplane=planes((6, 5, 4), 8, 12, (1, 2)), max_scale_change=0.0)
BASIS = Config(deformation=DeformationConfig(basis=BasisConfig(9, 12), max_scale_change=0.0))


def points(num: int = 60, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(num, 3, generator=generator) * torch.tensor([40.0, 30.0, 10.0]) + torch.tensor([-20.0, -15, 50])


def field(cfg: DeformationConfig = SMALL, seed: int = 0) -> HexPlaneField:
    return HexPlaneField.from_points(points(), cfg, torch.Generator().manual_seed(seed))


def test_box_is_max_then_min_and_never_flat() -> None:
    cloud = points()
    assert torch.equal(box_of_points(cloud), torch.stack([cloud.amax(0), cloud.amin(0)]))
    cloud[:, 2] = 7
    box = box_of_points(cloud)
    assert box[:, 2].tolist() == [7.5, 6.5]
    with pytest.raises(ValueError, match="finite"):
        box_of_points(torch.zeros(0, 3))
    with pytest.raises(ValueError, match="finite"):
        box_of_points(torch.full((2, 3), float("nan")))


def test_field_agrees_with_the_literal_formulas() -> None:
    """Offsets, and gradients of centers and box, where some Gaussians have left the box."""
    model = field()
    model.grid.values.uniform_(0.3, 1.1, generator=torch.Generator().manual_seed(2))
    means = (points(80, 1) * 1.05).requires_grad_(True)
    cotangent = torch.randn(80, 3, generator=torch.Generator().manual_seed(3))
    got = model.offsets(means, 0.6, NUMBA).means
    (got * cotangent).sum().backward()
    double_means = means.detach().double().requires_grad_(True)
    double_box = model.box.detach().double().requires_grad_(True)
    want = displacement(model, double_means, double_box, 0.6)
    (want * cotangent).sum().backward()
    # float32 sums of 24 and 32 terms around 1.
    torch.testing.assert_close(got, want.float(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(means.grad, double_means.grad.float(), rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(model.box.grad, double_box.grad.float(), rtol=1e-3, atol=1e-4)


def test_displacement_at_another_time_is_that_of_a_second_call() -> None:
    """Offsets, displacement and every gradient; heads other than that of the centers see one time only."""
    results = []
    for together in (True, False):
        model = field(replace(SMALL, deform_opacity=True))
        model.grid.values.uniform_(0.3, 1.1, generator=torch.Generator().manual_seed(2))
        means = (points(80, 1) * 1.05).requires_grad_(True)
        if together:
            offsets, displacement = model.offsets_and_displacement(means, 0.6, 0.2, NUMBA)
        else:
            offsets, displacement = model.offsets(means, 0.6, NUMBA), model.offsets(means, 0.2, NUMBA).means
        made = [displacement, *vars(offsets).values()]
        found = [value for value in made if value is not None]
        sum((k + 1) * value.square().sum() for k, value in enumerate(found)).backward()
        network = [tensor.grad for tensor in model.heads.parameters.values()]
        results.append([*found, means.grad, model.box.grad, model.grid.grads, *network])
    assert len(results[0]) == 5 + 3 + 18
    for together, apart in zip(*results, strict=True):
        torch.testing.assert_close(together, apart, rtol=1e-4, atol=1e-4)  # float32 sums over 80 Gaussians


def test_a_time_that_is_not_finite_is_rejected() -> None:
    with pytest.raises(ValueError, match="time must be finite"):
        field().offsets(points(), math.nan, NUMBA)


def test_network_gradients_by_central_differences() -> None:
    model, means = field(), points(40, 1)
    loss = lambda: model.offsets(means, 0.3, NUMBA).means.double().square().sum()  # noqa: E731
    loss().backward()
    with torch.no_grad():
        for tensor in model.heads.parameters.values():
            if tensor.grad is None:  # heads that this loss does not read
                continue
            index = int(tensor.grad.abs().argmax())
            flat, step = tensor.view(-1), 1e-2
            flat[index] += step
            above = loss().item()
            flat[index] -= 2 * step
            below = loss().item()
            flat[index] += step
            # The loss is piecewise polynomial of low degree; a ReLU of a few Gaussians may switch inside the step.
            assert (above - below) / (2 * step) == pytest.approx(tensor.grad.view(-1)[index].item(), rel=0.03)


def test_plane_gradients_reach_the_buffer_through_the_field() -> None:
    model = field()
    model.offsets(points(), 0.3, NUMBA).means.square().sum().backward()
    assert model.grid.grads.abs().sum() > 0
    fixed = field()
    fixed.box.requires_grad_(False)
    fixed.offsets(points(), 0.3, NUMBA).means.square().sum().backward()
    assert fixed.box.grad is None and fixed.grid.grads.abs().sum() > 0
    assert model.box.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("cfg", "fields"),
    [
        (SMALL, {"means": (7, 3), "quats": (7, 4), "log_scales": (7, 3)}),
        (replace(SMALL, deform_shape=False), {"means": (7, 3)}),
        (
            replace(SMALL, deform_opacity=True),
            {"means": (7, 3), "quats": (7, 4), "log_scales": (7, 3), "opacity_logits": (7,)},
        ),
    ],
)
def test_fields_of_the_offsets(cfg: DeformationConfig, fields: dict[str, tuple[int, ...]]) -> None:
    """EndoNeRF, SCARED, and the released code with its opacity head; nothing starts at zero offset."""
    model = field(cfg)
    found = {name: value for name, value in vars(model.offsets(points(7), 0.2, NUMBA)).items() if value is not None}
    assert {name: tuple(value.shape) for name, value in found.items()} == fields
    assert all((value != 0).any() for value in found.values())
    expected = {"trunk"} | {f"{name}.{layer}" for name in fields for layer in ("hidden", "output")}
    assert {name.rsplit(".", 1)[0] for name in model.heads.parameters} == expected


def test_offsets_of_no_gaussians_and_of_a_subset() -> None:
    model, cloud = field(), points()
    model.offsets(cloud[:0], 0.1, NUMBA).means.sum().backward()
    assert model.offsets(cloud[:0], 0.1, NUMBA).quats.shape == (0, 4)
    with torch.no_grad():
        everyone, few = model.offsets(cloud, 0.1, NUMBA), model.offsets(cloud[10:20], 0.1, NUMBA)
    # Matrix products of another height may block their sums in another way.
    torch.testing.assert_close(few.means, everyone.means[10:20], rtol=1e-5, atol=1e-6)


def test_heads_start_as_stated() -> None:
    width, features = 32, 256
    shapes = head_shapes(features, width, {"means": 3, "quats": 4})
    default = OffsetHeads(shapes, torch.Generator().manual_seed(1))
    zero = OffsetHeads(shapes, torch.Generator().manual_seed(1), zero_biases=True)
    for name, value in default.parameters.items():
        fan_in = features if name.startswith("trunk") else width
        if name.endswith("weight"):
            bound = math.sqrt(6 / sum(value.shape))  # Xavier uniform
            assert 0.9 * bound < value.abs().max() <= bound
        else:
            assert 0 < value.abs().max() <= 1 / math.sqrt(fan_in)
            assert not zero.parameters[name].any()
    again = OffsetHeads(shapes, torch.Generator().manual_seed(1))
    assert all(torch.equal(a, b) for a, b in zip(default.parameters.values(), again.parameters.values(), strict=True))


def test_seed_alone_decides_the_start() -> None:
    torch.manual_seed(123)
    before = torch.random.get_rng_state()
    first = field(seed=4).state_arrays()
    assert torch.equal(torch.random.get_rng_state(), before)  # the global generator is nobody's business
    second, other = field(seed=4).state_arrays(), field(seed=5).state_arrays()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not torch.equal(first["heads.trunk.weight"], other["heads.trunk.weight"])


def test_state_survives_a_file(tmp_path: Path) -> None:
    source, target = field(seed=1), field(seed=2)
    names = set(source.state_arrays())
    assert {"hexplane.box", "hexplane.0.xy", "hexplane.1.zt", "heads.trunk.weight"} <= names
    save_file(source.state_arrays(), tmp_path / "scene.safetensors")
    box, network = target.box, list(target.heads.parameters.values())
    target.load_state_arrays(load_file(tmp_path / "scene.safetensors"))
    assert torch.equal(target.offsets(points(), 0.7, NUMBA).means, source.offsets(points(), 0.7, NUMBA).means)
    # Optimizers hold these very tensors.
    assert target.box is box and next(iter(target.heads.parameters.values())) is network[0] and box.requires_grad


def test_a_wrong_state_is_refused() -> None:
    model, arrays = field(), dict(field().state_arrays())
    arrays["hexplane.0.xy"] = arrays["hexplane.0.xy"][:-1]
    with pytest.raises(InputError, match=r"hexplane\.0\.xy: expected"):
        model.load_state_arrays(arrays)
    del arrays["hexplane.0.xy"]
    with pytest.raises(InputError, match="got none"):
        model.load_state_arrays(arrays)


def test_time_moves_the_field_once_its_time_planes_differ() -> None:
    model, cloud = field(), points()
    assert torch.equal(
        model.offsets(cloud, 0.1, NUMBA).means, model.offsets(cloud, 0.9, NUMBA).means
    )  # time planes start at 1
    model.grid.plane(0, "xt")[-1] = 2
    assert not torch.equal(model.offsets(cloud, 0.1, NUMBA).means, model.offsets(cloud, 0.99, NUMBA).means)


def test_layout_of_changes_follows_the_configuration() -> None:
    assert change_layout(BASIS) == {"quats": slice(0, 4), "log_scales": slice(4, 7), "sh_dc": slice(7, 10)}
    rigid = BASIS.replace({"deformation.deform_shape": False, "deformation.deform_opacity": True})
    assert change_layout(rigid) == {"opacity_logits": slice(0, 1), "sh_dc": slice(1, 4)}
    assert temporal_shapes(rigid) == {"motion": (9, 3), "changes": (5, 4), "frame_motion": (12, 3)}
    both = rigid.replace({"data.eyes": "both"})
    assert change_layout(both) == change_layout(rigid) | {"gloss": slice(4, 7)}


def coefficients(num: int, cfg: Config, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return {
        name: torch.randn(num, *shape, generator=generator, dtype=dtype).requires_grad_(name != "frame_motion")
        for name, shape in temporal_shapes(cfg).items()
    }


@pytest.mark.parametrize("time", [0.0, 0.31, 0.5, 0.999])
def test_basis_by_its_definition(time: float) -> None:
    cfg = BASIS.replace({"deformation.deform_opacity": True, "data.eyes": "both"})
    tensors = coefficients(300, cfg)
    weights = {name: reference_basis.spline_weights(time, n) for name, n in (("motion", 9), ("changes", 5))}
    weights["frame_motion"] = reference_basis.frame_weights(time, 12)
    for name, values in basis_weights(time, cfg.deformation.basis).items():
        np.testing.assert_allclose(values, weights[name], atol=1e-12)
    totals = {
        name: sum(w * tensors[name][:, b].double() for b, w in enumerate(values)).float()
        for name, values in weights.items()
    }
    got = basis_offsets(tensors, time, cfg, NUMBA)
    torch.testing.assert_close(got.means, totals["motion"] + totals["frame_motion"], rtol=1e-5, atol=1e-6)
    parts = [got.quats, got.log_scales, got.opacity_logits[:, None], got.sh_dc, got.gloss]
    torch.testing.assert_close(torch.cat(parts, -1), totals["changes"], rtol=1e-5, atol=1e-6)  # few float32 terms


@pytest.mark.parametrize("count", [4, 5, 28])
def test_splines_sum_to_one_and_four_have_a_weight(count: int) -> None:
    for time in np.linspace(0, 1, 37):
        weights = spline_weights(time, count)
        assert weights.sum() == pytest.approx(1) and (weights >= 0).all() and np.count_nonzero(weights) <= 4
    assert not spline_weights(7.0, count).any()


@pytest.mark.parametrize("count", [1, 7, 49, 1000])
def test_a_frame_has_its_own_displacement_and_none_of_its_neighbors(count: int) -> None:
    for frame in range(count):
        np.testing.assert_array_equal(frame_weights(frame / count, count), np.eye(count)[frame])
    between = frame_weights(0.25 / count, count)
    np.testing.assert_allclose(between[:2], [0.75, 0.25][:count])


def test_the_spline_basis_is_well_conditioned() -> None:
    """So that Adam, which scales every coefficient on its own, reaches fast motion as soon as slow motion."""
    weights = np.stack([spline_weights(time, 40) for time in np.linspace(0, 1, 2000)])
    eigenvalues = np.linalg.eigvalsh(weights.T @ weights)[6:]  # without functions that reach beyond the ends
    assert eigenvalues[0] > 0.04 * eigenvalues[-1]


def test_basis_gradient() -> None:
    tensors = coefficients(3, BASIS, torch.float64)

    def offsets(motion: Tensor, changes: Tensor) -> tuple[Tensor, ...]:
        given = {"motion": motion, "changes": changes, "frame_motion": tensors["frame_motion"]}
        found = basis_offsets(given, 0.4, BASIS, NUMBA)
        return found.means, found.quats, found.log_scales, found.sh_dc

    assert torch.autograd.gradcheck(offsets, (tensors["motion"], tensors["changes"]))


def test_basis_starts_as_the_identity() -> None:
    tensors = {name: torch.zeros(4, *shape, requires_grad=True) for name, shape in temporal_shapes(BASIS).items()}
    found = basis_offsets(tensors, 0.25, BASIS, NUMBA)
    assert isinstance(found, Offsets) and found.opacity_logits is None
    assert not any(value.any() for value in (found.means, found.quats, found.log_scales, found.sh_dc))
    found.means.sum().backward()
    assert tensors["motion"].grad.any()  # and it can leave it
    assert tensors["frame_motion"].grad is None  # which only optical flow gives


def test_basis_of_no_gaussians_far_times_and_wrong_shapes() -> None:
    tensors = {name: torch.zeros(0, *shape, requires_grad=True) for name, shape in temporal_shapes(BASIS).items()}
    basis_offsets(tensors, 0.5, BASIS, NUMBA).means.sum().backward()
    assert tensors["motion"].grad.shape == tensors["motion"].shape
    ones = {name: torch.ones(2, *shape) for name, shape in temporal_shapes(BASIS).items()}
    assert not basis_offsets(ones, 5.0, BASIS, NUMBA).means.any()
    with pytest.raises(ValueError, match="changes"):
        basis_offsets(ones | {"changes": ones["changes"][..., :-1]}, 0.5, BASIS, NUMBA)
