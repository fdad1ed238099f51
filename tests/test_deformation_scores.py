"""Scores of displacement and stretch: closed forms, then a phantom whose tissue moves by a law."""

from __future__ import annotations

import numpy as np
import pytest

from endoprior.core.checks import InputError
from endoprior.core.geometry import Strain
from endoprior.data import load_sequence
from endoprior.data.truth import Deformation
from endoprior.evaluation.scorers.deformation import (
    PARTS,
    SCORES,
    Deformed,
    by_chained_flow,
    deformation_errors,
    parts_of,
    without_motion,
)
from endoprior.evaluation.scoring import evaluate
from endoprior.model.measures import SurfaceMotion
from endoprior.model.presets import preset
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.training.gaussian_trainer import GaussianTrainer

DIRECTIONS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])


def deformed(displacement: float, largest: float, smallest: float, direction: np.ndarray) -> Deformed:
    """Two frames of three points that all do the same."""
    stretch = np.broadcast_to([largest, smallest], (2, 3, 2)).copy()
    return Deformed(np.full((2, 3, 3), displacement), Strain(stretch, np.broadcast_to(direction, (2, 3, 3))))


def errors(found: Deformed, true: Deformed) -> dict[str, float]:
    """Over everything."""
    return deformation_errors(found, true, {"": np.ones((2, 3), bool)})


def test_the_truth_has_no_error_whatever_the_sign_of_its_direction():
    true, turned = deformed(1, 1.4, 0.9, DIRECTIONS[0]), deformed(1, 1.4, 0.9, -DIRECTIONS[0])
    assert list(errors(turned, true).values()) == pytest.approx([0, 0, 0, 0], abs=1e-6)


def test_errors_are_means_of_differences():
    true = deformed(0, 1.5, 0.8, DIRECTIONS[0])
    found = deformed(2, 1.2, 1.0, (DIRECTIONS[0] + DIRECTIONS[1]) / np.sqrt(2))
    assert errors(found, true) == pytest.approx(
        {
            "deformation_displacement_mm": 2 * np.sqrt(3),
            "deformation_stretch": 0.3,
            "deformation_area": 0,
            "deformation_direction_deg": 45,
        },
        abs=1e-6,
    )


def test_no_motion_has_no_direction_and_equal_stretches_have_none():
    true = deformed(3, 1.5, 0.8, DIRECTIONS[0])
    still = errors(without_motion(true), true)
    assert still["deformation_stretch"] == pytest.approx(0.5) and np.isnan(still["deformation_direction_deg"])
    even = deformed(3, 1.05, 1.0, DIRECTIONS[0])
    assert np.isnan(errors(even, even)["deformation_direction_deg"])


def test_unknown_values_do_not_count_and_parts_stand_apart():
    true, found = deformed(0, 1.5, 0.8, DIRECTIONS[0]), deformed(0, 1.5, 0.8, DIRECTIONS[0])
    found.strain.stretch[0, 0], found.strain.stretch[1] = np.nan, 1.7
    parts = {"": np.ones((2, 3), bool), "near": np.array([[True] * 3, [False] * 3]), "far": np.zeros((2, 3), bool)}
    scores = deformation_errors(found, true, parts)
    assert scores["deformation_stretch"] == pytest.approx(0.2 * 3 / 5) and scores["deformation_stretch_near"] == 0
    assert np.isnan(scores["deformation_stretch_far"])


# --- a phantom --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A small phantom that is pulled."""
    out = tmp_path_factory.mktemp("deformation") / "pull"
    write_phantom(out, PhantomConfig(frames=10, width=96, height=80, mechanics="pull", side_views=False))
    return out


def true_of(sequence) -> tuple[Deformed, np.ndarray, np.ndarray]:
    """True deformation, positions and visibility of what the first frame shows."""
    tracks, truth = sequence.truth.tracks, sequence.truth.deformation
    seen = tracks.visible[0]
    strain = Strain(*(values[:, seen] for values in truth.strain))
    return Deformed(truth.displacement[:, seen], strain), tracks.points[:, seen].astype(float), tracks.visible[:, seen]


def test_parts_divide_what_is_seen_by_its_distance(folder):
    sequence = load_sequence(folder)
    _, points, visible = true_of(sequence)
    parts = parts_of(points, visible, sequence)
    assert not parts[""][0].any() and (parts[""][1:] == visible[1:]).all()
    assert (sum(parts[name].astype(int) for name in PARTS) == parts[""]).all()
    assert (parts["hidden"][1:] == ~visible[1:]).all()
    x = 0.9 * 96 * points[..., 0] / points[..., 2] + 48
    at_border = (x < 1.5) & parts[""]  # a pixel is 0.9 mm here
    assert at_border.any() and parts["near"][at_border].all()


def test_flow_measures_motion_better_than_no_motion_does(folder):
    sequence = load_sequence(folder)
    true, points, visible = true_of(sequence)
    parts = parts_of(points, visible, sequence)
    flow, still = (
        deformation_errors(found, true, parts) for found in (by_chained_flow(points[0], sequence), without_motion(true))
    )
    assert flow["deformation_displacement_mm"] < 0.8 * still["deformation_displacement_mm"]
    assert flow["deformation_direction_deg"] < 40


def test_eval_scores_what_the_scene_measures(folder, monkeypatch):
    sequence = load_sequence(folder)
    true, _, _ = true_of(sequence)
    trainer = GaussianTrainer(sequence, preset("preview"))
    trainer.start()
    monkeypatch.setattr(SurfaceMotion, "strain", lambda *_: true.strain)
    result = evaluate(trainer.scene(), sequence, networks=False, speed=False)
    assert result.scores["deformation_stretch"] == result.scores["deformation_area"] == 0
    assert result.scores["deformation_direction_deg"] == pytest.approx(0, abs=0.1)
    assert 0 < result.scores["deformation_displacement_mm"] and "deformation_stretch_still" in result.scores
    assert 0 < result.scores["range_held_95"] <= 1 and "range_held_50_hidden" in result.scores
    named = {score.name for score in SCORES}
    assert named <= {*result.scores, *result.skipped} and "deformation_direction_deg_still" in result.skipped


def test_truth_is_read_and_bad_truth_is_said(folder, tmp_path):
    sequence = load_sequence(folder)
    assert isinstance(sequence.truth.deformation, Deformation)
    file, tracks = folder / "truth/mechanics.npz", folder / "truth/tracks.npz"
    kept, of_tracks = file.read_bytes(), tracks.read_bytes()
    try:
        with np.load(file) as stored:
            arrays = dict(stored)
        for name, bad in (("stretch", arrays["stretch"][:, :5]), ("direction", np.full((10, 256, 3), np.nan))):
            np.savez(file, **arrays | {name: bad})
            with pytest.raises(InputError, match=rf"mechanics.npz.*{name}"):
                _ = load_sequence(folder).truth.deformation
        file.write_bytes(kept)
        tracks.unlink()
        with pytest.raises(InputError, match=r"mechanics.npz.*tracks.npz"):
            _ = load_sequence(folder).truth.deformation
    finally:
        file.write_bytes(kept)
        tracks.write_bytes(of_tracks)
