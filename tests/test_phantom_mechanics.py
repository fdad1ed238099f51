"""Tissue that moves by a law: the phantom and its truth."""

from __future__ import annotations

import json

import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.phantom.mechanics import MovingSheet, solve_sheet
from endoprior.phantom.motion import build_motion
from endoprior.phantom.surface import build_anatomy, build_plane

AWAY = np.array([0.8, 0.3, 0.45])


def pulled_tissue(spacing: float) -> MovingSheet:
    """Bowel, pulled by 8 mm."""
    return solve_sheet(build_anatomy(1), np.array([3.0, -2]), 8 * AWAY / np.linalg.norm(AWAY), 0, 0, spacing)


def test_the_pull_converges_with_the_mesh():
    b, a = np.mgrid[-30:30:2.0, -30:30:2.0]
    coarse, medium, fine = (pulled_tissue(spacing).displacement(a, b, 1.0) for spacing in (9.0, 6.0, 4.0))
    errors = [np.linalg.norm(found - fine, axis=-1).mean() for found in (coarse, medium)]
    assert errors[1] < 0.12 and errors[1] < 0.5 * errors[0]


def test_displacement_is_smooth_and_none_without_load():
    sheet = pulled_tissue(5.0)
    b, a = np.mgrid[-100:100:20.0, -100:100:20.0]
    assert not sheet.displacement(a, b, 0.0).any() and np.abs(sheet.displacement(a, b, 1.0)[0]).max() < 0.05
    at = (np.array([3.0]), np.array([-2.0]))
    moved = np.stack([sheet.displacement(*at, s)[0] for s in np.linspace(0, 1, 41)])
    assert np.linalg.norm(moved[-1]) == pytest.approx(8, rel=0.15)
    assert np.abs(np.diff(moved, 2, axis=0)).max() < 0.05 * np.abs(np.diff(moved, axis=0)).max()


# --- the phantom ------------------------------------------------------------------------------------------------------

SMALL = {"frames": 12, "width": 96, "height": 80, "seed": 3, "side_views": False}


@pytest.fixture(
    scope="module", params=["pull", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("poke", "breathe"))]
)
def phantom(request, tmp_path_factory):
    """(kind, folder) of a small phantom of each kind."""
    out = tmp_path_factory.mktemp("mechanics") / request.param
    write_phantom(out, PhantomConfig(**SMALL, mechanics=request.param))
    return request.param, out


def test_truth_fits_the_tracks(phantom):
    kind, folder = phantom
    with np.load(folder / "truth/tracks.npz") as tracks, np.load(folder / "truth/mechanics.npz") as stored:
        points, truth = tracks["points"].astype(float), dict(stored)
    assert {name: value.shape for name, value in truth.items()} == {
        "displacement": (12, 256, 3), "stretch": (12, 256, 2), "direction": (12, 256, 3), "area": (12, 256),
    }  # fmt: skip
    assert truth["displacement"] == pytest.approx(points - points[0], abs=1e-4)
    assert truth["stretch"][0] == pytest.approx(1, abs=1e-5) and not truth["displacement"][0].any()
    assert truth["area"] == pytest.approx(truth["stretch"].prod(-1), abs=1e-5)
    assert np.linalg.norm(truth["direction"], axis=-1) == pytest.approx(1, abs=1e-5)
    assert truth["stretch"].min() > 0.2, "no triangle turns over"
    largest = truth["stretch"][..., 0].max()
    assert {"pull": largest > 1.25, "poke": largest > 1.1, "breathe": 1.02 < largest < 1.2}[kind]
    assert f"mechanics {kind}" in json.loads((folder / "sequence.json").read_text())["note"]


def test_neighbors_change_their_distance_as_the_true_stretch_says(phantom):
    """Lengths between near tracks, over those at rest, lie between the two principal stretches of both."""
    _, folder = phantom
    with np.load(folder / "truth/tracks.npz") as tracks, np.load(folder / "truth/mechanics.npz") as truth:
        points, stretch = tracks["points"].astype(float), truth["stretch"]
    gaps = np.linalg.norm(points[0][:, None] - points[0], axis=-1) + 99 * np.eye(256)
    near = np.argwhere(np.triu(gaps < 2.5))
    assert len(near) > 10
    apart = [np.linalg.norm(points[k][near[:, 0]] - points[k][near[:, 1]], axis=-1) for k in (0, 6)]
    both = stretch[6][near]
    low, high = both[..., 1].min(1) - 0.08, both[..., 0].max(1) + 0.08
    assert np.mean((apart[1] / apart[0] > low) & (apart[1] / apart[0] < high)) > 0.9


def test_the_tool_holds_what_it_moves():
    cfg = PhantomConfig(seed=1, mechanics="poke")
    motion = build_motion(cfg, build_plane(cfg), build_anatomy(1))
    pull = motion.pulls[0]
    assert np.allclose(motion.tools(0.5)[0].tip, motion.held(pull, 0.5), atol=1e-9)
    assert (motion.held(pull, 0.55) - motion.held(pull, 0.0)) @ motion.plane.axes[2] < -0.8 * cfg.pull_mm
    assert motion.tools(0.0)[0].opening < 0.1, "it pokes with closed jaws"


@pytest.mark.slow
def test_same_seed_gives_the_same_bytes_and_no_truth_of_mechanics_without(tmp_path):
    for name, kind in (("one", "poke"), ("again", "poke"), ("usual", "none")):
        write_phantom(tmp_path / name, PhantomConfig(**SMALL | {"frames": 2, "mechanics": kind}))
    for name in ("truth/mechanics.npz", "images/000001.png"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "one" / name).read_bytes()
    assert not (tmp_path / "usual/truth/mechanics.npz").exists()


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({"slide_mm": 2.0}, "--slide-mm"), ({"breathing_mm": 2.0}, "--breathing-mm"), ({"pull_mm": 20.0}, "pull_mm"),
        ({"scene": "tube"}, "--mechanics"), ({"mechanics": "breathe", "pull_mm": 9.0}, "--pull-mm"),
        ({"mechanics": "push"}, "pull, poke, breathe"),
    ],
)  # fmt: skip
def test_options_that_do_not_go_together_are_errors(change, wrong):
    with pytest.raises(InputError, match=wrong):
        PhantomConfig(**{"mechanics": "pull"} | change)
