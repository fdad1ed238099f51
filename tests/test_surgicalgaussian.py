"""SurgicalGaussian: the facts of the release, one by one, and that it trains, resumes and comes back from disk."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from method_runs import trained_and_resumed
from scipy.spatial.transform import Rotation

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.core.types import RenderOutput
from endoprior.data import load_sequence
from endoprior.evaluation.scorers import image as metrics
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.presets import preset
from endoprior.training.density import DensityStats
from endoprior.training.frames import TrainingFrames
from endoprior.training.ops import NUMBA
from endoprior.training.state import ForwardPass
from endoprior.training.trainer import Stage
from endoprior_baselines.released import grid_points
from endoprior_baselines.surgicalgaussian import (
    METHOD,
    TimeNetwork,
    covariances,
    distance_change,
    encoded,
    neighbor_terms,
    ssim,
    state_shapes,
)

CFG = preset("surgicalgaussian")


def gaussians_at(points, scale_mm=1.0):
    """Gray Gaussians at points (N, 3), mm."""
    points = np.asarray(points, np.float32)
    return create_gaussians(points, np.full((len(points), 3), 0.5), np.full(len(points), np.log(scale_mm)), CFG)


def network(seed: int = 0) -> TimeNetwork:
    return TimeNetwork.fresh(torch.Generator().manual_seed(seed))


# The network.


def test_layers_are_eight_of_256_with_one_skip():
    weights = {name: shape for name, shape in state_shapes().items() if name.endswith("weight")}
    inputs = [shape[1] for shape in weights.values()]
    assert inputs == [72, 256, 256, 256, 256, 328, 256, 256, 256, 256, 256]
    assert [shape[0] for shape in weights.values()] == [256] * 8 + [3, 4, 3]
    assert set(METHOD.motion(CFG).parameter_shapes(CFG)) == set(network().parameters)


def test_the_encoding_by_hand():
    value = torch.tensor([[0.5, 0.25]])
    found = encoded(value, 2)
    x = value.numpy()
    expected = np.concatenate([x, np.sin(x), np.cos(x), np.sin(2 * x), np.cos(2 * x)], 1)
    torch.testing.assert_close(found, torch.from_numpy(expected))


def test_the_start_is_pytorchs_and_not_rest():
    field = network()
    for name, value in field.state_arrays().items():
        bound = state_shapes()[name.rsplit(".", 1)[0] + ".weight"][1] ** -0.5
        assert value.abs().max() <= bound and value.abs().max() > 0.1 * bound, name
    assert field(torch.zeros(1, 3), 0.0)["means"].abs().max() > 0


def test_offsets_are_added_after_activation():
    gaussians, field = gaussians_at(np.random.default_rng(0).normal(size=(6, 3)) * 20), network()
    with torch.no_grad():
        gaussians["quats"].mul_(3.0)
    offsets = METHOD.motion(CFG).offsets(gaussians, field, 0.4, CFG, NUMBA.model)
    found, splats = field(gaussians["means"].detach() / 100, 0.4), gaussians.splats(offsets, 0)
    torch.testing.assert_close(splats.means, gaussians["means"] + 100 * found["means"])
    torch.testing.assert_close(splats.scales, (1.0 + 100 * found["scales"]).abs(), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(splats.quats, gaussians["quats"] / 3 + found["quats"], rtol=1e-4, atol=1e-5)
    splats.means.sum().backward()
    assert gaussians["means"].grad.eq(1).all(), "the network gets centers without their gradient"


# Terms.


def test_similarity_is_that_of_the_scores():
    rng = np.random.default_rng(0)
    image, target = rng.random((2, 30, 40, 3)).astype(np.float32)
    mask = np.ones((30, 40), bool)
    expected = metrics.ssim(image, target, mask)
    assert float(ssim(torch.from_numpy(image), torch.from_numpy(target))) == pytest.approx(expected, abs=1e-4)
    same = torch.from_numpy(image)
    assert float(ssim(same, same)) == pytest.approx(1)


def test_covariances_are_those_of_rotations():
    rng = np.random.default_rng(1)
    quats, scales = rng.normal(size=(5, 4)), rng.random((5, 3))
    turned = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix() * scales[:, None]
    full = turned @ turned.transpose(0, 2, 1)
    expected = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(covariances(torch.from_numpy(quats), torch.from_numpy(scales)), expected, atol=1e-12)


def test_a_rigid_motion_changes_no_distance():
    points = torch.randn(8, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    turn = torch.from_numpy(Rotation.from_rotvec([0.2, 0.5, -0.1]).as_matrix())
    neighbors = torch.arange(8)[:, None].roll(1, 0)
    assert float(distance_change(points, points @ turn.T + 3, neighbors)) < 1e-9
    assert float(distance_change(points, 2 * points, neighbors)) == pytest.approx(
        float((points - points[neighbors[:, 0]]).norm(dim=1).mean())
    )
    same = torch.zeros(2, 3, requires_grad=True)
    distance_change(same, same, torch.tensor([[1], [0]])).backward()
    assert same.grad.isfinite().all(), "points that coincide"


def test_threads_do_not_change_the_order_of_sums():
    rng = torch.Generator().manual_seed(0)
    neighbors = torch.randint(0, 6000, (6000, 5), generator=rng)
    before, after = torch.randn(2, 6000, 6, generator=rng)
    gradients, threads = [], torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        for _ in range(20):
            moved = after.clone().requires_grad_()
            (distance_change(before, moved, neighbors) * 1e3).backward()
            gradients.append(moved.grad)
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(gradients[0], each) for each in gradients)


def test_neighbor_terms_by_hand():
    gaussians = gaussians_at([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10], [10, 10, 0]])
    offsets = METHOD.motion(CFG).offsets(gaussians, network(), 0.2, CFG, NUMBA.model)
    splats = gaussians.splats(offsets, 0)
    found = neighbor_terms(gaussians, offsets, splats)
    before, after = gaussians["means"] / 100, splats.means / 100
    rows = [[j for j in range(5) if j != i] for i in range(5)]  # all four others
    change = [abs((before[i] - before[j]).norm() - (after[i] - after[j]).norm()) for i in range(5) for j in rows[i]]
    assert float(found["distance"].detach()) == pytest.approx(
        0.2 * float(torch.stack(change).mean().detach()), rel=1e-4
    )
    assert found["shape"].detach() > 0


def test_the_loss_by_hand(tiny_sequence):
    frames = TrainingFrames(load_sequence(tiny_sequence))
    frame = frames.frame(0)
    depth = frame.depth
    out = RenderOutput(frame.rgb + 0.1, torch.ones_like(depth), depth + 5, torch.zeros(1, 2), torch.zeros(1))
    forward = ForwardPass(Stage.COARSE, 1, 0, frame, gaussians_at(np.eye(3)), None, None, None, out, None, None)
    terms = {name: float(value.detach()) for name, value in METHOD.terms(forward, CFG, NUMBA).items()}
    assert terms["color"] == pytest.approx(0.8 * 0.1 * float(frame.tissue_mask.float().mean()), rel=1e-4)
    assert terms["depth"] == pytest.approx(0.001 * 5 * float(frame.measured.float().mean()) / 100, rel=1e-4)
    assert terms["ssim"] > 0 and terms["tv"] > 0 and set(terms) == {"color", "ssim", "tv", "depth"}


# Start, rates, growth.


def test_points_start_at_every_third_pixel_where_first_seen(tiny_sequence):
    frames = load_sequence(tiny_sequence, DataConfig()).frames("train")
    cloud = grid_points(frames, 3, 1)
    cells = np.zeros_like(frames[0].tissue_mask)
    cells[1::3, 1::3] = True
    seen = np.zeros_like(cells)
    for position, frame in enumerate(frames):
        new = cells & ~seen & frame.tissue_mask & frame.depth_valid
        assert np.count_nonzero(cloud.origins == position) == np.count_nonzero(new)
        seen |= new
    assert len(cloud) == np.count_nonzero(seen)
    with pytest.raises(InputError, match="at least 4 points"):
        grid_points([replace(frames[0], tissue_mask=np.zeros_like(frames[0].tissue_mask))], 3, 1)


def test_rates_at_given_iterations():
    means, net = METHOD.rate("means", CFG, 7.0), METHOD.rate("network.layer.0.weight", CFG, 7.0)
    assert [means(0), means(3000), means(4000)] == pytest.approx([1.6e-2, 1.6e-4, 1.6e-4])
    assert [net(0), net(4000)] == pytest.approx([1.6e-4, 1.6e-6]) and net(3000) == pytest.approx(1.6e-4 * 10**-1.5)
    others = {"sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 0.05, "log_scales": 1e-3, "quats": 1e-3}
    assert {name: METHOD.rate(name, CFG, 1.0)(9) for name in others} == others


def test_growth_removal_and_resets():
    gaussians = create_gaussians(
        np.zeros((5, 3)), np.zeros((5, 3)), np.log([0.9, 1.1, 11.0, 0.5, 0.5]), CFG, opacities=np.full(5, 0.5)
    )
    stats = DensityStats.zeros(5)
    stats.num_seen += 1
    stats.grad2d_ndc_sum += torch.tensor([3e-4, 3e-4, 0, 0, 2e-4])
    plan = METHOD.plan(stats, gaussians, 0.0, Stage.FINE, 3000, CFG)
    assert plan.clone.tolist() == [True, False, False, False, False] and not plan.remove.any()
    assert plan.split.tolist() == [False, True, False, False, False]
    later = METHOD.plan(stats, gaussians, 0.0, Stage.FINE, 3100, CFG)
    assert later.remove.tolist() == [False, False, True, False, False]
    published = CFG.replace({"density.stop_iteration": 15_000})
    for cfg, wanted in ((published, [500, 3000]), (CFG, [500])):
        assert [i for i in (400, 500, 3000, 3100, 15_000) if METHOD.reset_due(Stage.FINE, i, cfg)] == wanted
    assert CFG.density.stop_iteration / CFG.schedule.fine_iterations == 15_000 / 40_000
    fitted = METHOD.fitted(CFG.replace({"fit_to_clip": True, "schedule.fine_iterations": 930}), 24)
    assert fitted.density.stop_iteration == 349
    assert [i for i in range(1, 931) if METHOD.reset_due(Stage.FINE, i, fitted)] == [279]


# All together.


@pytest.mark.slow
def test_it_trains_resumes_with_equal_bits_and_comes_back(tiny_sequence, tmp_path):
    changes = {"density.start_iteration": 2, "density.every": 3, "schedule.sh_every": 3}
    cfg = preset("surgicalgaussian", iterations=8, **changes)
    assert isinstance(trained_and_resumed(load_sequence(tiny_sequence), cfg, tmp_path, stop_at=5).field, TimeNetwork)
