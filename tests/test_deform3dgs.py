"""Deform3DGS: the facts of the release, one by one, and that it trains, resumes and comes back from disk."""

import numpy as np
import pytest
import torch
from method_runs import trained_and_resumed

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.core.types import Camera, Frame, RenderOutput
from endoprior.data import load_sequence
from endoprior.initialization.first_gaussians import create_gaussians
from endoprior.model.presets import preset
from endoprior.training.adam import AdamState, adam_unstored_step
from endoprior.training.adam import adam_step_numba as adam_step
from endoprior.training.density import DensityStats
from endoprior.training.frames import TrainingFrames
from endoprior.training.ops import NUMBA, TORCH
from endoprior.training.state import ForwardPass
from endoprior.training.trainer import Stage
from endoprior_baselines.deform3dgs import METHOD, first_points
from endoprior_baselines.learned_basis import COEFFICIENTS, value_at


def coefficients(num: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    """Weights, centers and widths near their start, (num, 17, 10) each."""
    generator = torch.Generator().manual_seed(seed)
    noise = lambda scale: scale * torch.randn(num, 17, 10, generator=generator, dtype=torch.float64)  # noqa: E731
    centers = torch.linspace(0, 1, 17, dtype=torch.float64)[None, :, None]
    return [value.to(dtype).requires_grad_() for value in (noise(1.0), centers + noise(0.02), 0.02 + noise(0.02))]


def tiny():
    """A config that trains in a second, with density events."""
    changes = {"density.start_iteration": 2, "density.every": 3, "density.grow_threshold": 1e-9}
    return preset("deform3dgs", iterations=8, **changes, **{"schedule.sh_every": 3})


# What one Gaussian has.


def test_a_gaussian_has_510_coefficients_that_start_at_rest():
    cfg = preset("deform3dgs")
    gaussians = create_gaussians(np.zeros((2, 3)), np.full((2, 3), 0.5), np.zeros(2), cfg)
    weights, centers, widths = (gaussians[name].detach() for name in COEFFICIENTS)
    assert sum(gaussians[name][0].numel() for name in COEFFICIENTS) == 510
    assert not weights.any() and (widths == 0.01).all()
    assert torch.equal(centers[1, :, 7], torch.linspace(0, 1, 17))
    offsets = METHOD.motion(cfg).offsets(gaussians, None, 0.5, cfg, NUMBA.model)
    assert not offsets.means.any() and not offsets.quats.any() and not offsets.log_scales.any()
    assert offsets.opacity_logits is None and offsets.sh_dc is None


def test_fitted_to_the_clip_a_held_out_frame_shares_basis_functions_with_its_neighbors(tiny_sequence, tmp_path):
    cfg = preset("deform3dgs", fit_to_clip=True)
    for frames, width in ((12, 1 / 12), (24, 1 / 24), (48, 0.035), (156, 0.035)):
        fitted = METHOD.fitted(cfg, frames)
        assert fitted.first_width == width and METHOD.fitted(fitted, frames) == fitted
        gaussians = create_gaussians(np.zeros((1, 3)), np.full((1, 3), 0.5), np.zeros(1), fitted)
        centers, widths = (gaussians[name][0, :, 0].detach().double() for name in COEFFICIENTS[1:])
        times = torch.arange(frames)[:, None] / frames
        seen = torch.exp(-(((times - centers) ** 2 / (widths**2 + 1e-4)) ** 2))  # (T, B)
        shared = torch.minimum(seen[1:-1], torch.maximum(seen[:-2], seen[2:])).amax(1)
        assert float(shared.min()) > 0.1, "of each frame, with one of its neighbors"
    short = tiny().replace({"fit_to_clip": True})
    scene = trained_and_resumed(load_sequence(tiny_sequence), short, tmp_path, stop_at=4)
    assert scene.config.first_width == 1 / len(scene.cameras)


def test_channels_are_centers_then_rotation_then_scales():
    cfg = preset("deform3dgs")
    gaussians = create_gaussians(np.zeros((1, 3)), np.full((1, 3), 0.5), np.zeros(1), cfg)
    with torch.no_grad():
        gaussians["basis_weights"][0, 8] = torch.arange(10.0)  # centered at 0.5
    offsets = METHOD.motion(cfg).offsets(gaussians, None, 0.5, cfg, NUMBA.model)
    found = torch.cat([offsets.means, offsets.quats, offsets.log_scales], 1)
    torch.testing.assert_close(found, torch.arange(10.0)[None])
    chosen = METHOD.motion(cfg).offsets(gaussians, None, 0.5, cfg, NUMBA.model, torch.tensor([0, 0]))
    assert chosen.means.tolist() == [[0, 1, 2]] * 2


# The basis functions.


def test_a_basis_function_by_hand():
    one = torch.zeros(1, 17, 10)
    weights, centers, widths = one.clone(), one.clone(), one.clone()
    weights[0, 0, 0], centers[0, 0, 0], widths[0, 0, 0] = 2.0, 0.5, 0.01
    for time, expected in ((0.5, 2.0), (0.5 + 0.0002**0.5, 2 / np.e), (0.55, 0.0)):  # s^2 + 1e-4 = 2e-4
        assert float(value_at(weights, centers, widths, time)[0, 0]) == pytest.approx(expected, rel=1e-4, abs=1e-30)


@pytest.mark.parametrize("num", [1, 5, 23])  # 170 coefficients each: lanes are left over
@pytest.mark.parametrize("time", [0.0, 0.31, 1.0])
def test_values_are_those_of_a_slow_loop(time, num):
    given = coefficients(num)
    for sink in (None, []):
        found = value_at(*given, time, sink).detach()
        weights, centers, widths = (tensor.detach().double().numpy() for tensor in given)
        ratio = (time - centers) ** 2 / (widths**2 + 1e-4)
        expected = [[sum(weights[n, b, c] * np.exp(-(ratio[n, b, c] ** 2)) for b in range(17)) for c in range(10)]
                    for n in range(num)]  # fmt: skip
        torch.testing.assert_close(found.double(), torch.tensor(expected), rtol=1e-5, atol=1e-6)


def test_gradients_are_those_of_central_differences():
    assert torch.autograd.gradcheck(lambda *c: value_at(*c, 0.3), coefficients(2, dtype=torch.float64))


@pytest.mark.parametrize("num", [1, 23])
@pytest.mark.parametrize("times", [(0.3,), (0.3, 0.35)])
def test_a_step_with_unstored_gradients_is_one_with_those_of_autograd(times, num):
    ours, theirs = coefficients(num), coefficients(num)
    states = [[AdamState(tensor) for tensor in tensors] for tensors in (ours, theirs)]
    random = torch.Generator().manual_seed(1)
    for _ in range(3):
        pulls = [torch.randn(num, 10, generator=random) for _ in times]
        sink: list = []
        sum((value_at(*ours, t, sink) * pull).sum() for t, pull in zip(times, pulls, strict=True)).backward()
        assert [tensor.grad for tensor in ours] == [None] * 3
        adam_unstored_step(states[0], ours, sink, 1e-2, 1e-15)
        sum((value_at(*theirs, t) * pull).sum() for t, pull in zip(times, pulls, strict=True)).backward()
        adam_step(states[1], theirs, 1e-2, 1e-15)
        for tensor in theirs:
            tensor.grad = None
        for mine, other in zip(*states, strict=True):
            scale = float(other.first.abs().max())
            torch.testing.assert_close(mine.first, other.first, rtol=1e-3, atol=1e-5 * scale)
            # On a steep flank a rounding of t - c is 1e-3 of a gradient, and twice that of its square.
            torch.testing.assert_close(mine.second, other.second, rtol=5e-3, atol=1e-9 * scale**2)
            assert mine.steps == other.steps
            mine.load(other.arrays())  # an epsilon of 1e-15 makes a step of any rounding: compare one step at a time
    for mine, other, first in zip(ours, theirs, states[1], strict=True):
        felt = first.first.abs() > 1e-4 * first.first.abs().max()
        torch.testing.assert_close(mine[felt], other[felt], rtol=1e-3, atol=1e-4)


# Rates, frames, growth.


def test_rates_at_given_iterations():
    cfg = preset("deform3dgs")
    for name in ("means", *COEFFICIENTS):
        rate = METHOD.rate(name, cfg, 123.0)  # the path of the camera changes nothing
        assert [rate(i) for i in (0, 3000, 4000)] == pytest.approx([1.6e-3, 5.0596e-5, 1.6e-5], rel=1e-4)
    for name, expected in {"sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 0.05, "log_scales": 5e-3}.items():
        assert METHOD.rate(name, cfg, 1.0)(1) == METHOD.rate(name, cfg, 1.0)(3000) == expected
    assert METHOD.rate("quats", cfg, 1.0)(1) == 1e-3


def test_density_control_only_splits_and_prunes():
    cfg = preset("deform3dgs")
    assert METHOD.density_due(Stage.FINE, 600, False, cfg) and not METHOD.density_due(Stage.FINE, 500, False, cfg)
    assert not METHOD.density_due(Stage.FINE, 3000, True, cfg)
    gaussians = create_gaussians(np.random.default_rng(0).random((6, 3)), np.full((6, 3), 0.5), np.full(6, -9.0), cfg)
    with torch.no_grad():
        gaussians["opacity_logits"][0] = -8.0
    stats = DensityStats.zeros(6)
    stats.num_seen += 1
    stats.grad2d_ndc_sum += torch.tensor([1, 1, 1, 0, 0, 0]) * 2e-4
    for extent in (0.0, 50.0):
        plan = METHOD.plan(stats, gaussians, extent, Stage.FINE, 600, cfg)
        assert not plan.clone.any() and plan.split.tolist() == [False, True, True, False, False, False]
        assert plan.remove.tolist() == [True, False, False, False, False, False]


# The loss.


def test_the_loss_by_hand(tiny_sequence):
    frames = TrainingFrames(load_sequence(tiny_sequence))
    frame = frames.frame(0)
    height, width = frame.tissue_mask.shape
    out = RenderOutput(
        color=frame.rgb + 0.25,
        alpha=torch.ones(height, width),
        depth=torch.where(frame.inverse_depth > 0, 1 / (frame.inverse_depth.clamp(min=1e-6) + 0.125), 0),
        means2d=torch.zeros(1, 2),
        radii=torch.zeros(1, dtype=torch.int32),
    )
    for ops in (NUMBA, TORCH):
        forward = ForwardPass(Stage.FINE, 1, 0, frame, None, None, None, None, out, None, None)
        terms = METHOD.terms(forward, preset("deform3dgs"), ops)
        values = {name: float(value) for name, value in terms.items()}
        assert values["color"] == pytest.approx(0.25, rel=1e-4) and values["depth"] == pytest.approx(0.125, rel=1e-3)
        assert values["tv"] == 0 and values["edges"] == 0


# First points.


def plane(index: int, tissue: np.ndarray, gray: np.ndarray, depth: float = 50.0) -> Frame:
    """A frame of a plane that faces a still camera."""
    height, width = tissue.shape
    camera = Camera(width, height, 100.0, 100.0, width / 2, height / 2, np.eye(4))
    return Frame(
        index,
        index / 10,
        camera,
        np.repeat(gray[..., None], 3, 2).astype(np.uint8),
        tissue,
        np.full(tissue.shape, depth, np.float32),
        np.ones_like(tissue),
    )


def test_other_frames_add_only_what_the_first_does_not_show():
    gray = np.full((60, 60), 128)
    hidden = np.ones((60, 60), bool)
    hidden[:, :20] = False
    frames = [plane(0, hidden, gray), plane(1, np.ones((60, 60), bool), gray), plane(2, np.ones((60, 60), bool), gray)]
    cloud = first_points(frames, 0)
    later = cloud.origins == 1
    assert len(cloud) == (60 * 40 + 120) // 10 and set(cloud.origins) == {0, 1}, "frame 2 has nothing new"
    assert (cloud.points[later, 0] < -5).all() and (cloud.points[~later, 0] > -5).all()  # 20 of 60 px at 0.5 mm each
    assert np.allclose(cloud.points[:, 2], 50)


def test_what_moves_in_the_first_frame_is_started_from_all():
    moved = np.full((200, 200), 128)
    slight = moved.copy()
    moved[20:50, 20:50] = 200
    slight[100:] += 1
    tissue = np.ones((200, 200), bool)
    cloud = first_points([plane(0, tissue, moved), plane(1, tissue, slight)], 0)
    later = cloud.points[cloud.origins == 1]
    assert len(later) > 3 and (np.abs(later[:, :2] + 32.5) <= 7.5).all()  # px 20 to 50 of 200, 0.5 mm each


def test_equal_seeds_give_equal_points_and_no_depth_is_an_error():
    gray, tissue = np.full((40, 40), 100), np.ones((40, 40), bool)
    frames = [plane(0, tissue, gray)]
    assert np.array_equal(first_points(frames, 1).points, first_points(frames, 1).points)
    assert not np.array_equal(first_points(frames, 1).points, first_points(frames, 2).points)
    with pytest.raises(InputError, match="at least 4 points"):
        first_points([plane(0, np.zeros((40, 40), bool), gray)], 0)


# All together.


def test_it_trains_resumes_with_equal_bits_and_comes_back(tiny_sequence, tmp_path):
    scene = trained_and_resumed(load_sequence(tiny_sequence, DataConfig()), tiny(), tmp_path, stop_at=5)
    assert scene.field is None
