"""Tracks as supervision: what the term is worth, whom it moves, and which track a new Gaussian has."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from endoprior.core.types import Camera
from endoprior.data import load_sequence
from endoprior.model.presets import preset
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior.training.ops import NUMBA, TORCH
from endoprior.training.tracks import StartTracks

CAMERA = Camera(320, 256, 300.0, 300.0, 160.0, 128.0, np.eye(4))
FRAME = SimpleNamespace(time=0.4, camera=CAMERA, reliability=1.0)


def at_depth(*depths: float) -> torch.Tensor:
    return torch.tensor([[0.0, 0.0, z] for z in depths])


def still_tracks(num: int, followed: list[list[float]]) -> StartTracks:
    """Tracks of points that do not move."""
    return StartTracks(torch.zeros(len(followed[0]), num, 3), torch.tensor(followed).T, torch.arange(num))


def random_case(seed: int = 0):
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(7, 3, generator=g) + torch.tensor([0.0, 0.0, 50.0])
    offsets = torch.randn(7, 3, generator=g, dtype=torch.float64).float().requires_grad_()
    displacement, followed = torch.randn(5, 4, 3, generator=g), torch.rand(5, 4, generator=g)
    return means, offsets, StartTracks(displacement, followed, torch.tensor([0, 1, 2, 3, 3, 1, 0]))


def test_one_millimeter_at_a_known_depth():
    # 1 mm at 60 mm is 300 / 60 = 5 px of a frame 320 px wide, so 10 px of one 640 px wide.
    offsets = torch.tensor([[1.0, 0.0, 0.0]])
    term = NUMBA.track_term(at_depth(60.0), offsets, still_tracks(1, [[1.0]]), FRAME, 0)
    assert term.item() == pytest.approx(math.sqrt(10**2 + 1) - 1, rel=1e-5)


def test_where_the_flow_lost_the_point_or_it_is_behind_the_camera_nothing_counts():
    offsets = torch.ones(2, 3, requires_grad=True)
    tracks = still_tracks(2, [[1.0, 0.0], [1.0, 1.0]])
    term = NUMBA.track_term(at_depth(60.0, -60.0), offsets, tracks, FRAME, 1)
    term.backward()
    assert term.item() == 0 and not offsets.grad.any()


@pytest.mark.parametrize("ops", [NUMBA, TORCH])
def test_agrees_with_a_loop(ops):
    means, offsets, tracks = random_case()
    total = 0.0
    for n, row in enumerate(tracks.rows.tolist()):
        wanted = tracks.displacement[3, row].double()
        px = 2 * 300 / (means[n, 2] + wanted[2]).item()
        error = px * (offsets[n].detach().double() - wanted).norm().item()
        total += tracks.followed[3, row].item() * (math.sqrt(error**2 + 1) - 1)
    term = ops.track_term(means, offsets, tracks, FRAME, 3)
    assert term.item() == pytest.approx(total / 7, rel=1e-4)


@pytest.mark.parametrize("ops", [NUMBA, TORCH])
def test_gradient_goes_to_the_offsets_and_is_that_of_differences(ops):
    means, offsets, tracks = random_case(1)
    means.requires_grad_()
    (2 * ops.track_term(means, offsets, tracks, FRAME, 2)).backward()
    assert means.grad is None
    for n, axis in ((0, 0), (3, 1), (6, 2)):
        values = []
        for step in (1e-2, -1e-2):
            moved = offsets.detach().clone()
            moved[n, axis] += step
            values.append(TORCH.track_term(means, moved, tracks, FRAME, 2).item())
        assert offsets.grad[n, axis].item() == pytest.approx(2 * (values[0] - values[1]) / 2e-2, rel=2e-2, abs=1e-4)


def test_a_track_itself_costs_nothing():
    means, _, tracks = random_case(2)
    offsets = tracks.displacement[0][tracks.rows]
    offsets.requires_grad_()
    term = NUMBA.track_term(means, offsets, tracks, FRAME, 0)
    term.backward()
    assert term.item() == 0 and not offsets.grad.any()


def test_children_keep_the_track_of_their_parent():
    _, _, tracks = random_case()
    grown = tracks.inherited(torch.tensor([6, 6, 2]))
    assert grown.rows.tolist() == [0, 0, 2]
    assert grown.displacement is tracks.displacement


@pytest.mark.slow
def test_training_is_held_to_the_tracks(tiny_sequence):
    """With a great weight motion stays nearer to where it started than without the term."""
    distance = {}
    for weight in (0.0, 100.0):
        changes = {"loss.track_weight": weight, "density.start_iteration": 1000}
        trainer = GaussianTrainer(
            load_sequence(tiny_sequence), preset("default", gaussians=200, iterations=30, **changes)
        )
        trainer.start()
        start = trainer.state.gaussians["motion"].detach().clone()
        assert (trainer.state.tracks is None) == (weight == 0)
        trainer.run([])
        distance[weight] = (trainer.state.gaussians["motion"].detach() - start).abs().mean().item()
    assert distance[100.0] < 0.5 * distance[0.0]
