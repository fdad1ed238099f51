"""Endo-4DGS: the facts of the release, one by one, and that it trains, resumes and comes back from disk."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hexplane_grids import planes
from method_runs import trained_and_resumed
from scipy.spatial.transform import Rotation

from endoprior.core.config_deformation import HexPlaneConfig
from endoprior.core.types import RenderOutput, Splats
from endoprior.data import load_sequence
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.gaussians import SH_C0
from endoprior.model.presets import preset
from endoprior.runs.train import train
from endoprior.training.density import DensityStats
from endoprior.training.frames import TrainingFrames
from endoprior.training.ops import NUMBA
from endoprior.training.state import ForwardPass
from endoprior.training.trainer import Stage
from endoprior_baselines.endo4dgs import (
    METHOD,
    SmallField,
    confident_error,
    gradient_correlation,
    normals_of_depth,
    rendered_normals,
    smallest_axes,
    without_scale,
)

CFG = preset("endo4dgs")
SMALL = planes((6, 5, 4), 7, 3, (1, 2))


def test_the_field_has_the_published_shapes():
    shapes = SmallField.state_shapes(CFG.deformation)
    assert shapes["hexplane.0.xy"] == (64, 64, 32) and shapes["hexplane.1.zt"] == (75, 128, 32)
    assert "hexplane.2.xy" not in shapes and "box" not in SmallField.parameter_shapes(CFG.deformation)
    weights = [shape for name, shape in shapes.items() if name.endswith("weight")]
    assert weights == [(64, 64), (64, 64), (3, 64), (64, 64), (4, 64), (64, 64), (3, 64)]
    gaussians = create_gaussians(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4), CFG)
    field = METHOD.motion(CFG).field(torch.rand(9, 3), CFG)
    offsets = METHOD.motion(CFG).offsets(gaussians, field, 0.3, CFG, NUMBA.model)
    assert offsets.opacity_logits is None and offsets.sh_dc is None and offsets.quats.shape == (4, 4)


# Terms.


def test_depth_without_scale_by_hand():
    depth = torch.tensor([[1.0, 2.0], [4.0, 100.0]])
    found = without_scale(depth, torch.tensor([[True, True], [True, False]]))
    torch.testing.assert_close(found, torch.tensor([[0.25, 0.5], [1, 0]]), rtol=1e-5, atol=0)


def test_gradient_correlation_is_that_of_numpy():
    rng = np.random.default_rng(0)
    a, b, valid = rng.random((9, 11)), rng.random((9, 11)), rng.random((9, 11)) < 0.8
    squares = [[], []]
    for v in range(8):
        for u in range(10):
            if valid[v, u] and valid[v, u + 1] and valid[v + 1, u]:
                for k, depth in enumerate((a, b)):
                    squares[k].append((depth[v, u + 1] - depth[v, u]) ** 2 + (depth[v + 1, u] - depth[v, u]) ** 2)
    expected = 1 - np.corrcoef(*squares)[0, 1]
    found = gradient_correlation(*(torch.from_numpy(x) for x in (a, b, valid)))
    assert float(found) == pytest.approx(expected, rel=1e-6)
    none = gradient_correlation(torch.from_numpy(a), torch.from_numpy(b), torch.zeros(9, 11, dtype=torch.bool))
    assert float(none) == 0


def test_flat_depth_has_a_finite_gradient():
    slope = 0.25 * torch.arange(6.0).expand(5, 6)
    curved, all_valid = torch.rand(5, 6, generator=torch.Generator().manual_seed(0)), torch.ones(5, 6, dtype=torch.bool)
    for flat in (torch.full((5, 6), 40.0), 40 + slope):
        for depth, target in ((flat, curved), (curved, flat), (flat, flat)):
            depth = depth.clone().requires_grad_()
            gradient_correlation(depth, target, all_valid).backward()
            assert depth.grad.abs().max() < 1e7


def test_normals_of_a_slanted_plane():
    v, u = np.mgrid[:5, :6]
    found = normals_of_depth(torch.from_numpy(10 + 0.5 * u - 0.25 * v))
    expected = np.array([0.5, 0.25, -1]) / np.linalg.norm([0.5, 0.25, -1])
    np.testing.assert_allclose(found, np.broadcast_to(expected, (5, 6, 3)), atol=1e-12)


def test_the_thinnest_axis_is_a_column_of_the_rotation():
    rng = np.random.default_rng(1)
    quats, scales = rng.normal(size=(7, 4)), rng.random((7, 3))
    rotation = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    expected = rotation[np.arange(7), :, scales.argmin(1)]
    splats = Splats(torch.zeros(7, 3), torch.from_numpy(quats), torch.from_numpy(scales), torch.ones(7), torch.ones(7))
    np.testing.assert_allclose(smallest_axes(splats), expected, atol=1e-12)


def test_normals_are_drawn_as_colors_in_a_second_pass():
    sh = torch.randn(2, 4, 3)
    quats = torch.tensor([[1.0, 0, 0, 0], [1.0, 0, 0, 0]])
    scales = torch.tensor([[1.0, 1, 0.1], [0.1, 1, 1]])
    drawn = []
    rendered_normals(Splats(torch.zeros(2, 3), quats, scales, torch.ones(2), sh), lambda s: drawn.append(s) or _black())
    color = drawn[0].sh[:, 0] * SH_C0 + 0.5
    torch.testing.assert_close(color, torch.tensor([[0.5, 0.5, 1], [1, 0.5, 0.5]]))
    assert torch.equal(drawn[0].sh[:, 1:], sh[:, 1:])


def _black() -> RenderOutput:
    return RenderOutput(*(torch.zeros(1),) * 5)


def test_confident_error_by_hand():
    value, target = torch.tensor([[1.0], [3.0]]), torch.tensor([[0.0], [1.0]])
    confidence = torch.tensor([0.5, 1.0])
    expected = 2.5 / 1.25 + np.log(0.5) / 2  # (1 + 4) / 2, then (2 / 4 + 2) / 2
    assert float(confident_error(value, target, confidence)) == pytest.approx(expected)
    assert confident_error(value, target, torch.zeros(2)).isfinite()


def test_the_loss_by_hand(tiny_sequence):
    frame = TrainingFrames(load_sequence(tiny_sequence)).frame(0)
    ones = torch.ones_like(frame.depth)
    out = RenderOutput(frame.rgb + 0.1, ones, 2 * frame.depth, torch.zeros(1, 2), torch.zeros(1))
    gray = create_gaussians(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4), CFG).splats(None, 0)
    forward = ForwardPass(Stage.COARSE, 1, 0, frame, None, None, None, gray, out, lambda splats: out, None)
    terms = {name: float(value.detach()) for name, value in METHOD.terms(forward, CFG, NUMBA).items()}
    assert terms["color"] == pytest.approx(0.1 * float(frame.tissue_mask.float().mean()), rel=1e-4)
    assert terms["depth"] == pytest.approx(0, abs=1e-6) and terms["gradient"] == pytest.approx(0, abs=1e-6)
    assert terms["confidence"] == pytest.approx(0.001 * (0.01 / 2), rel=1e-3)  # c = 1: MSE / 2, for color alone
    assert set(terms) == {"color", "depth", "gradient", "normal", "confidence"}


def test_depth_is_divided_by_alpha_and_confidence_trains_nothing(tiny_sequence):
    frame = TrainingFrames(load_sequence(tiny_sequence)).frame(0)
    alpha = torch.linspace(0.2, 0.9, frame.depth.numel()).reshape(frame.depth.shape).requires_grad_()
    out = RenderOutput(frame.rgb + 0.1, alpha, alpha.detach() * frame.depth, torch.zeros(1, 2), torch.zeros(1))
    gray = create_gaussians(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4), CFG).splats(None, 0)
    forward = ForwardPass(Stage.COARSE, 1, 0, frame, None, None, None, gray, out, lambda splats: out, None)
    terms = METHOD.terms(forward, CFG, NUMBA)
    assert float(terms["depth"].detach()) == pytest.approx(0, abs=1e-6)
    (1e6 * terms["confidence"]).backward()
    assert float(alpha.grad.abs().max()) < 0.1, "only by the depth, which fits: not by the confidence"
    assert CFG.render.depth_grad_to_means


def test_a_frame_without_tissue_has_finite_terms_and_gradients(tiny_sequence):
    frame = TrainingFrames(load_sequence(tiny_sequence)).frame(0)
    none = torch.zeros_like(frame.tissue_mask)
    frame = replace(frame, tissue_mask=none, measured=none, num_measured=0)
    color, depth = frame.rgb.requires_grad_(), frame.depth.requires_grad_()
    out = RenderOutput(color, torch.ones_like(depth), depth, torch.zeros(1, 2), torch.zeros(1))
    gray = create_gaussians(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4), CFG).splats(None, 0)
    forward = ForwardPass(Stage.COARSE, 1, 0, frame, None, None, None, gray, out, lambda splats: out, None)
    terms = METHOD.terms(forward, CFG, NUMBA)
    sum(terms.values()).backward()
    assert all(bool(value.isfinite()) for value in terms.values())
    assert color.grad.isfinite().all() and depth.grad.isfinite().all()


# Rates, growth.


def test_rates_at_given_iterations():
    expected = {"means": 1.6e-4, "network.0": 1.6e-4, "planes": 1.6e-3}
    for name, first in expected.items():
        rate = METHOD.rate(name, CFG, 50.0)
        assert [rate(0), rate(20_000)] == pytest.approx([first, first / 100])
    others = {"sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 0.05, "log_scales": 5e-3, "quats": 1e-3}
    assert {name: METHOD.rate(name, CFG, 1.0)(9) for name in others} == others


def test_a_still_camera_splits_and_few_gaussians_are_never_removed():
    gaussians = create_gaussians(
        np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), CFG, opacities=np.array([0.5, 0.001, 0.5])
    )
    stats = DensityStats.zeros(3)
    stats.num_seen += 1
    stats.grad2d_ndc_sum += torch.tensor([2e-4, 0, 1e-4])
    plan = METHOD.plan(stats, gaussians, 0.0, Stage.FINE, 600, CFG)
    assert plan.split.tolist() == [True, False, False] and not plan.clone.any() and not plan.remove.any()
    assert METHOD.density_due(Stage.FINE, 1400, False, CFG) and not METHOD.density_due(Stage.FINE, 1500, False, CFG)


# All together.


def test_it_trains_resumes_with_equal_bits_and_comes_back(tiny_sequence, tmp_path):
    changes = {"density.start_iteration": 2, "density.every": 3, "density.grow_threshold": 1e-6}
    cfg = preset("endo4dgs", iterations=6, **changes)
    cfg = replace(
        cfg,
        schedule=replace(cfg.schedule, coarse_iterations=4, sh_every=3),
        deformation=replace(cfg.deformation, hexplane=HexPlaneConfig(7, 3, (1,))),
    )
    sequence, seen = load_sequence(tiny_sequence), []
    train(sequence, cfg, on_step=lambda report, _: seen.append(set(report.losses)))
    assert seen[-1] == seen[0] | {"tv", "planes"}
    trained_and_resumed(sequence, cfg, tmp_path, stop_at=4)
