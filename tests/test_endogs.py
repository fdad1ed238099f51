"""EndoGS: the facts of the release, one by one, and that it trains, resumes and comes back from disk."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hexplane_grids import planes
from method_runs import trained_and_resumed

from endoprior.core.config_deformation import HexPlaneConfig
from endoprior.core.types import RenderOutput
from endoprior.data import load_sequence
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.hexplane import FRESH, PLANE_NAMES, PlaneGrid
from endoprior.model.presets import preset
from endoprior.runs.train import train
from endoprior.training.density import DensityStats
from endoprior.training.frames import TrainingFrames
from endoprior.training.gaussian_hooks import in_epochs
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.ops import NUMBA, TORCH
from endoprior.training.state import ForwardPass
from endoprior.training.trainer import Stage
from endoprior_baselines.endogs import METHOD, JointField, depth_huber
from endoprior_baselines.plane_terms import PlaneWeights, plane_term

CFG = preset("endogs")
SMALL = planes((6, 5, 4), 7, 3, (1, 2))


def tiny():
    """A config that trains in a second, with growth, pruning of nothing and a reset."""
    changes = {"density.start_iteration": 2, "density.every": 3, "density.grow_threshold": 1e-6}
    cfg = preset("endogs", gaussians=200, **{"schedule.fine_iterations": 7}, **changes)
    schedule = replace(cfg.schedule, coarse_iterations=4, sh_every=3)
    return replace(cfg, schedule=schedule, deformation=replace(cfg.deformation, hexplane=HexPlaneConfig(7, 3, (1,))))


# The field.


def test_planes_and_network_have_the_published_shapes():
    shapes = JointField.state_shapes(CFG.deformation)
    assert shapes["hexplane.0.xy"] == (64, 64, 32) and shapes["hexplane.3.xz"] == (512, 512, 32)
    assert shapes["hexplane.2.yt"] == (75, 256, 32) and shapes["hexplane.box"] == (2, 3)
    layers = {name: shape for name, shape in shapes.items() if name.endswith("weight")}
    assert list(layers.values()) == [(256, 128), (256, 256), (256, 256), (59, 256)]
    assert "box" in JointField.parameter_shapes(CFG.deformation)


def test_the_field_is_its_formula():
    cfg = replace(CFG, deformation=replace(CFG.deformation, hexplane=SMALL))
    field = METHOD.motion(cfg).field(torch.rand(20, 3, generator=torch.Generator().manual_seed(0)), cfg)
    gaussians = create_gaussians(np.random.default_rng(1).random((9, 3)), np.full((9, 3), 0.5), np.zeros(9), cfg)
    found = METHOD.motion(cfg).offsets(gaussians, field, 0.4, cfg, NUMBA.model)
    (values,) = field.trunk(gaussians["means"], (0.4,), TORCH.model)
    for layer in ("second", "hidden", "output"):
        weight, bias = (field.heads.parameters[f"{layer}.{part}"] for part in ("weight", "bias"))
        values = values.relu() @ weight.T + bias
    expected = dict(zip(("means", "log_scales", "quats"), values[:, :10].split([3, 3, 4], 1), strict=True))
    expected["means"] = 10 * expected["means"]  # mm
    expected |= {"opacity_logits": values[:, 10], "sh_dc": values[:, 11:14]}
    expected["sh_rest"] = values[:, 14:].reshape(9, 15, 3)
    for name, value in expected.items():
        torch.testing.assert_close(getattr(found, name), value, rtol=1e-4, atol=1e-5)
    splats = gaussians.splats(found, 3)
    torch.testing.assert_close(splats.sh[:, 1:], gaussians["sh_rest"] + found.sh_rest)
    torch.testing.assert_close(splats.opacities, (gaussians["opacity_logits"] + found.opacity_logits).sigmoid())


# Regularizers of the planes.


def random_grid() -> PlaneGrid:
    """A small one with random values."""
    grid = PlaneGrid(SMALL)
    grid.values.normal_(1, 0.5, generator=torch.Generator().manual_seed(2))
    return grid


def slow_plane_term(grid: PlaneGrid, weights: PlaneWeights) -> torch.Tensor:
    """The formula, plane by plane, in autograd."""
    total = torch.zeros((), dtype=torch.float64)
    for scale in range(grid.num_scales):
        for name in PLANE_NAMES:
            plane = grid.plane(scale, name).double()
            smooth, ones = weights.of(name)
            total = total + smooth * (plane[2:] - 2 * plane[1:-1] + plane[:-2]).square().mean()
            total = total + ones * (1 - plane).abs().mean()
    return total


def test_plane_terms_are_their_formula_and_its_gradient():
    weights, grid, anchor = PlaneWeights(0.3, 0.2, 0.7), random_grid(), torch.zeros(1, requires_grad=True)
    value = plane_term(grid, weights, anchor)
    grid.values.requires_grad_()
    expected = slow_plane_term(grid, weights)
    expected.backward()
    assert float(value.detach()) == pytest.approx(float(expected.detach()), rel=1e-5)
    wanted, grid.values = grid.values.grad, grid.values.detach()
    (3 * plane_term(grid, weights, anchor)).backward()
    torch.testing.assert_close(grid.grads, 3 * wanted, rtol=1e-4, atol=1e-7)
    assert (grid.marks & FRESH).all() and anchor.grad is None
    flat = PlaneGrid(SMALL)
    assert float(plane_term(flat, PlaneWeights(1, 1, 1), anchor).detach()) == 0, "planes of ones cost nothing"
    assert PlaneWeights(1, 2, 3).of("xz") == (1, 0) and PlaneWeights(1, 2, 3).of("zt") == (2, 3)


# Loss, frames, growth.


def test_the_loss_by_hand(tiny_sequence):
    frames = TrainingFrames(load_sequence(tiny_sequence))
    hidden = sum((~frames.frame(i).tissue_mask).double() for i in range(len(frames)))
    weight = METHOD.context(frames, CFG)
    torch.testing.assert_close(weight.double(), 1 + 30 * hidden / hidden.square().sum().sqrt())
    frame = frames.frame(0)
    depth = frame.depth
    out = RenderOutput(frame.rgb + 0.1, torch.ones_like(depth), 2 * depth, torch.zeros(1, 2), torch.zeros(1))
    forward = ForwardPass(Stage.COARSE, 1, 0, frame, None, None, None, None, out, None, weight)
    terms = METHOD.terms(forward, CFG, NUMBA)
    assert float(terms["color"]) == pytest.approx(0.1 * float((weight * frame.tissue_mask).mean()), rel=1e-4)
    outside = out.color * ~frame.tissue_mask[..., None]
    steps = (outside[1:] - outside[:-1]).abs().sum() + (outside[:, 1:] - outside[:, :-1]).abs().sum()
    assert float(terms["tv"]) == pytest.approx(0.01 * float(steps) / outside.numel(), rel=1e-4)
    assert set(terms) == {"color", "depth", "tv"}


def test_at_half_resolution_a_pixel_has_the_mean_weight_of_its_block(tiny_sequence):
    frames = TrainingFrames(load_sequence(tiny_sequence))
    weight, frame = METHOD.context(frames, CFG), frames.frame(0, half=True)
    out = RenderOutput(frame.rgb + 0.1, torch.ones(20, 24), frame.depth, torch.zeros(1, 2), torch.zeros(1))
    forward = ForwardPass(Stage.FINE, 1, 0, frame, None, random_field(), None, None, out, None, weight)
    terms = METHOD.terms(forward, CFG, NUMBA)
    blocks = weight.reshape(20, 2, 24, 2).mean((1, 3))
    assert float(terms["color"]) == pytest.approx(0.1 * float((blocks * frame.tissue_mask).mean()), rel=1e-4)


def random_field() -> JointField:
    """A small one around random points."""
    cfg = replace(CFG, deformation=replace(CFG.deformation, hexplane=SMALL))
    return METHOD.motion(cfg).field(torch.rand(20, 3, generator=torch.Generator().manual_seed(0)), cfg)


def test_planes_are_regularized_whether_or_not_the_box_is_learned(tiny_sequence):
    frame = TrainingFrames(load_sequence(tiny_sequence)).frame(0)
    out = RenderOutput(frame.rgb, torch.ones(40, 48), frame.depth, torch.zeros(1, 2), torch.zeros(1))
    for learns_box in (True, False):
        field = random_field()
        field.box.requires_grad_(learns_box)
        forward = ForwardPass(Stage.FINE, 1, 0, frame, None, field, None, None, out, None, torch.ones(40, 48))
        METHOD.terms(forward, CFG, NUMBA)["planes"].backward()
        assert field.grid.grads.any(), learns_box


def test_depth_is_compared_without_its_scale():
    target = torch.tensor([[10.0, 20.0], [40.0, 0.0]])
    measured = target > 0
    assert float(depth_huber(3 * target, target, measured)) == pytest.approx(0, abs=1e-9)
    depth = torch.tensor([[10.0, 40.0], [40.0, 99.0]])  # the largest lies where nothing was measured
    scaled, wanted = depth / 99 * measured, target / 40
    gap = (scaled - wanted).abs()
    expected = torch.where(gap < 0.2, 0.5 * gap**2, 0.2 * (gap - 0.1)).mean()
    assert float(depth_huber(depth, target, measured)) == pytest.approx(float(expected), rel=1e-4)


def test_rates_at_given_iterations():
    for name, expected in {"network.0": 7.5e-4, "planes": 7.5e-3, "box": 7.5e-2}.items():
        rate = METHOD.rate(name, CFG, 77.0)
        assert [rate(1), rate(60_000)] == pytest.approx([expected] * 2)
    means = METHOD.rate("means", CFG, 77.0)
    assert means(0) == pytest.approx(8e-3) and means(60_000) == pytest.approx(0.76 * 8e-3, rel=5e-3)
    others = {"sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 0.05, "log_scales": 5e-3, "quats": 1e-3}
    assert {name: METHOD.rate(name, CFG, 1.0)(9) for name in others} == others


def test_every_frame_comes_once_in_an_epoch():
    order = [METHOD.position(replace(CFG, seed=3), Stage.FINE, iteration, 5, None) for iteration in range(1, 16)]
    assert [sorted(order[i : i + 5]) for i in (0, 5, 10)] == [[0, 1, 2, 3, 4]] * 3 and order[:5] != order[5:10]
    assert order[6] == in_epochs(3, Stage.FINE, 7, 5)


def test_it_grows_often_prunes_seldom_and_resets():
    scales = np.log([0.4, 0.6, 0.4, 6, 0.4])
    opacities = np.array([0.5, 0.5, 0.001, 0.5, 0.5])
    gaussians = create_gaussians(np.zeros((5, 3)), np.zeros((5, 3)), scales, CFG, opacities=opacities)
    stats = DensityStats.zeros(5)
    stats.num_seen += 1
    stats.grad2d_ndc_sum += torch.tensor([2e-4, 2e-4, 0, 0, 0])
    plan = METHOD.plan(stats, gaussians, 0.0, Stage.FINE, 6900, CFG)
    assert plan.clone.tolist() == [True, False, False, False, False] and not plan.remove.any()
    assert plan.split.tolist() == [False, True, False, False, False]
    pruned = METHOD.plan(stats, gaussians, 0.0, Stage.FINE, 7000, CFG)
    assert pruned.remove.tolist() == [False, False, True, True, False]
    due = [i for i in (400, 500, 600, 3000, 6000, 12_000, 48_000) if METHOD.reset_due(Stage.FINE, i, CFG)]
    assert due == [500, 6000, 12_000]
    fitted = METHOD.fitted(CFG.replace({"fit_to_clip": True, "schedule.fine_iterations": 1200}), 24)
    assert fitted.density.stop_iteration == 900 and METHOD.fitted(fitted, 24) == fitted
    assert [i for i in range(1, 1201) if METHOD.reset_due(Stage.FINE, i, fitted)] == [840]
    assert not METHOD.reset_due(Stage.COARSE, 840, fitted)
    assert not METHOD.density_due(Stage.FINE, 45_000, False, CFG) and METHOD.density_due(Stage.COARSE, 600, False, CFG)


# All together.


@pytest.mark.slow
def test_it_trains_resumes_with_equal_bits_and_comes_back(tiny_sequence, tmp_path):
    scene = trained_and_resumed(load_sequence(tiny_sequence), tiny(), tmp_path, stop_at=4)
    assert isinstance(scene.field, JointField) and len(scene) != 200, "it grew"


def test_the_optimizer_is_kept_and_a_reset_forgets_opacities(tiny_sequence, monkeypatch):
    trainer = GaussianTrainer(load_sequence(tiny_sequence), tiny())
    trainer.start()
    for _ in range(4):
        trainer.step()
    before, steps = trainer.state.optimizer, float(trainer.state.optimizer.states["means"].steps)
    monkeypatch.setattr(type(METHOD), "reset_due", lambda *args: True)
    trainer.step()
    assert trainer.state.stage is Stage.FINE and trainer.state.optimizer is before
    assert float(before.states["means"].steps) == steps + 1
    assert float(trainer.state.gaussians.opacities.detach().max()) <= 0.01 + 1e-6
    assert not before.states["opacity_logits"].first.any()


def test_training_does_not_end_with_a_reset(tiny_sequence, monkeypatch):
    monkeypatch.setattr(type(METHOD), "reset_due", lambda self, stage, iteration, cfg: iteration in (4, 7))
    trainer = GaussianTrainer(load_sequence(tiny_sequence), tiny())
    trainer.start()
    seen = [(trainer.step(), float(trainer.state.gaussians.opacities.detach().max()))[1] for _ in range(11)]
    assert trainer.finished
    reset = [i for i, most in enumerate(seen, 1) if most <= 0.01 + 1e-6]
    assert reset == [4, 8], "the last of the coarse stage; and fine iteration 4, but not 7, the last"


def test_what_is_empty_is_white(tiny_sequence, tmp_path):
    scene = train(load_sequence(tiny_sequence), tiny(), tmp_path / "run")
    with torch.no_grad():
        scene.gaussians["opacity_logits"].sub_(30)
        scene.field.heads.parameters["output.bias"][10] -= 30
    torch.testing.assert_close(scene.render(0.2).color, torch.ones(40, 48, 3))
