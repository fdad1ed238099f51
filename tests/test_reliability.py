"""How far frames and pixels are believed: which are left out, what counts less, and that all else is as before."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reader_checks import assert_rejected, edit_json, remark_with
from tiny_training import losses_of, tiny_config

from endoprior.core.config import DataConfig
from endoprior.data import load_sequence, shrunk
from endoprior.data.pixels import weighted
from endoprior.data.writer import FrameFiles, SequenceMeta
from endoprior.initialization.sampling import initial_points, pixel_probability
from endoprior.model.presets import preset
from endoprior.training.frames import TrainingFrames


def weigh(folder: Path, unexplained: list[int] | None = None, weights: dict[int, float] | None = None) -> None:
    """Mark frames of the tiny sequence, which has 17."""
    values = [(weights or {}).get(i, 1.0) for i in range(17)]
    edit_json(folder / "sequence.json", unexplained_frames=unexplained or [], frame_weights=values)


def test_frames_of_weight_zero_are_in_neither_split(tiny_sequence):
    weigh(tiny_sequence, [3, 9], {5: 0.0, 6: 0.5})
    sequence = load_sequence(tiny_sequence)
    assert sequence.left_out == [3, 5, 9]
    assert sequence.indices("test") == [1] and sequence.indices("video") == list(range(17))
    assert sequence.indices("train") == [i for i in range(17) if i not in (1, 3, 5, 9)]
    assert "without the unreliable frames 3, 5, 9" in sequence.split_rule
    assert remark_with(tiny_sequence, "3 of 17 frames have no camera pose, or show another scene")
    part = sequence.part(4, 12)
    assert part.left_out == [1, 5] and part.frame(2).weight.max() == 0.5
    reading = DataConfig(skip_frames="0-2")
    assert load_sequence(tiny_sequence, reading).left_out == [0, 2, 6]


def test_published_presets_take_all_frames_as_they_are(tiny_sequence):
    weigh(tiny_sequence, [3], {6: 0.5})
    for name in ("paper", "released", "endogaussian", "deform3dgs"):
        sequence = load_sequence(tiny_sequence, preset(name).data)
        assert sequence.left_out == [] and 3 in sequence.indices("train") and sequence.frame(6).weight is None
    assert preset("default").data.reliability == preset("best").data.reliability == "used"


def test_where_nothing_would_be_left_all_frames_are_used_and_that_is_said(tiny_sequence):
    weigh(tiny_sequence, list(range(1, 17)))
    assert load_sequence(tiny_sequence).left_out == []
    assert remark_with(tiny_sequence, "all are used, because nothing would be left")


@pytest.mark.parametrize("weights", [[1.0] * 16, [1.0] * 16 + [1.5], [1.0] * 16 + [-0.1], [1.0] * 16 + ["1"], 1.0])
def test_bad_weights_are_rejected(tiny_sequence, weights):
    edit_json(tiny_sequence / "sequence.json", frame_weights=weights)
    assert_rejected(tiny_sequence, "sequence.json", "frame_weights")


def test_weights_are_written_where_they_say_something(tmp_path, tiny_sequence):
    frame = load_sequence(tiny_sequence).frame(0)
    height, width = frame.tissue_mask.shape
    meta = json.loads((tiny_sequence / "sequence.json").read_text())
    facts = SequenceMeta(width, height, *(meta[name] for name in ("fx", "fy", "cx", "cy", "frames_per_second")))
    files = FrameFiles(tmp_path, facts)
    for _ in range(2):
        files.add(frame.rgb_u8, ~frame.tissue_mask, frame.depth)
    files.finish(frame_weights=[1, 1])
    assert "frame_weights" not in json.loads((tmp_path / "sequence.json").read_text())
    files.finish(frame_weights=[1, 0.25])
    assert json.loads((tmp_path / "sequence.json").read_text())["frame_weights"] == [1.0, 0.25]


def test_usual_highlights_count_and_a_saturated_part_counts_half(tiny_sequence):
    frame = load_sequence(tiny_sequence).frame(0)
    assert frame.weight is None
    rgb = frame.rgb_u8.copy()
    rgb[20, 20] = 255  # one highlight
    assert weighted(replace(frame, rgb_u8=rgb), 1.0).weight is None
    rgb[15:30, 20:35] = 255
    weight = weighted(replace(frame, rgb_u8=rgb), 0.5).weight
    assert (weight[15:30, 20:35] == 0.25).all() and (weight[:10] == 0.5).all() and (weight[14, 20:35] == 0.25).all()


def test_overexposed_tissue_keeps_its_place(tiny_sequence):
    frame = load_sequence(tiny_sequence).frame(0)
    rgb, sampler = frame.rgb_u8.copy(), replace(preset("default").init, sampler="prior")
    rgb[15:30, 20:35] = 255
    white = weighted(replace(frame, rgb_u8=rgb, tissue_mask=np.ones_like(frame.tissue_mask)), 1.0)
    assert (pixel_probability(white, sampler)[15:30, 20:35] > 0).sum() == white.depth_valid[15:30, 20:35].sum() > 0


def test_a_shrunk_weight_is_the_mean_of_its_block(tiny_sequence):
    weigh(tiny_sequence, weights={2: 0.5})
    frame = load_sequence(tiny_sequence).frame(2)
    weight = frame.weight.copy()
    weight[:2, 0] = 0
    small = shrunk(replace(frame, weight=weight), 2)
    assert small.weight[0, 0] == 0.25 and (small.weight[1:] == 0.5).all()


def test_prior_score_and_first_points_believe_a_frame_by_its_weight(tiny_sequence):
    whole = TrainingFrames(load_sequence(tiny_sequence))
    weigh(tiny_sequence, weights={2: 0.4})
    sequence = load_sequence(tiny_sequence)
    frames, at = TrainingFrames(sequence), sequence.indices("train").index(2)
    np.testing.assert_allclose(frames.prior(at)[0], 0.4 * whole.prior(at)[0], rtol=1e-6)
    assert not frames.prior(at)[1].any() and whole.prior(at)[1].any()
    assert frames.frame(at).reliability == pytest.approx(0.4) and frames.frame(0).reliability == 1
    cfg = replace(preset("default").init, budget=320)
    counts = np.bincount(initial_points(sequence.frames("train"), cfg).origins)
    assert counts[at] == pytest.approx(0.4 * counts[0], abs=1)


@pytest.mark.parametrize("kind", ["basis", "hexplane"])
def test_weights_of_one_change_nothing_and_lower_ones_do(tiny_sequence, kind):
    cfg = tiny_config(kind)
    before = losses_of(tiny_sequence, cfg)
    weigh(tiny_sequence)
    assert losses_of(tiny_sequence, cfg) == before
    weigh(tiny_sequence, weights={0: 0.5})
    assert losses_of(tiny_sequence, cfg) != before
    ignored = replace(cfg, data=replace(cfg.data, reliability="ignored"))
    assert losses_of(tiny_sequence, ignored) == before
