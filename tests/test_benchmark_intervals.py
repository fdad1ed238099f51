"""Intervals over seeds and frames: closed forms, a slow loop, what counts as one frame, and how often they hold."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from endoprior_studies.matrix import Matrix, frames_of
from endoprior_studies.results import Results
from endoprior_studies.spec import Cell, MethodSpec, SequenceSpec, Spec
from endoprior_studies.statistics import Difference, Pair, difference


def pair(ours, theirs=None, seed=0, fold=0, place="clip") -> Pair:
    """Values of the frames of a fold; theirs are 0 where not given."""
    ours = np.atleast_1d(np.asarray(ours, float))
    other = np.zeros_like(ours) if theirs is None else np.atleast_1d(np.asarray(theirs, float))
    return Pair(place, seed, ours, other, tuple(100 * fold + k for k in range(len(ours))))


def test_without_frames_it_is_the_interval_of_a_t_test():
    rng = np.random.default_rng(1)
    for count in (2, 3, 9):
        values = rng.uniform(1, 2, count)
        found = difference("psnr", [pair(value, seed=k) for k, value in enumerate(values)])
        low, high = stats.t.interval(0.95, count - 1, values.mean(), stats.sem(values))
        assert (found.mean, found.low, found.high) == pytest.approx((values.mean(), low, high))
        assert (found.count, found.over_frames) == (count, False)


def test_more_seeds_do_not_make_up_for_few_frames():
    """Two frames, better by 0 and by 1, for every seed: the t-test of these two, however many seeds show them."""
    low, high = stats.t.interval(0.95, 1, 0.5, 0.5)
    for count in (2, 8):
        found = difference("psnr", [pair([0, 1], seed=k) for k in range(count)])
        assert (found.mean, found.low, found.high, found.over_frames) == pytest.approx((0.5, low, high, True))


def test_more_folds_do_not_make_up_for_few_seeds():
    """Two seeds, better by 0 and by 1 in every fold: the t-test of these two, however many folds they train."""
    low, high = stats.t.interval(0.95, 1, 0.5, 0.5)
    for folds in (1, 3):
        found = difference("psnr", [pair(float(seed), seed=seed, fold=f) for seed in (0, 1) for f in range(folds)])
        assert (found.mean, found.low, found.high) == pytest.approx((0.5, low, high))


def test_one_seed_gives_no_interval():
    """Of any place: what one seed shows there can be chance."""
    found = difference("psnr", [pair([1, 2, 3], fold=f) for f in range(3)])
    assert found.mean == 2 and math.isnan(found.low) and math.isnan(found.high)
    both = [pair([1, 2], seed=k) for k in range(3)]
    assert math.isfinite(difference("psnr", both).low)
    assert math.isnan(difference("psnr", [*both, pair([1, 2], place="phantom")]).low)


@pytest.mark.parametrize("score", ["psnr", "depth_rmse_mm"])
def test_a_slow_loop_gives_the_same(score):
    """Places of unequal folds and frames; the share to first order by its differences."""
    rng = np.random.default_rng(2)
    sizes = {"clip": {0: 3, 1: 4}, "phantom": {0: 1}}
    pairs = [
        pair(rng.uniform(1, 2, n), rng.uniform(1, 2, n), seed, fold, place)
        for place, folds in sizes.items()
        for fold, n in folds.items()
        for seed in range(3)
    ]

    def gain(a, b):
        return a - b if score == "psnr" else (b - a) / b

    variances, means = [], []
    for place, folds in sizes.items():
        own = {(p.seed, p.frames[0] // 100): p for p in pairs if p.place == place}
        slopes = {}
        for key, p in own.items():
            a, b, step = p.ours.mean(), p.theirs.mean(), 1e-6
            by_a = (gain(a + step, b) - gain(a - step, b)) / (2 * step)
            by_b = (gain(a, b + step) - gain(a, b - step)) / (2 * step)
            slopes[key] = [gain(a, b) + by_a * (x - a) + by_b * (y - b) for x, y in zip(p.ours, p.theirs, strict=True)]
        of_seed = [np.mean([np.mean(slopes[seed, fold]) for fold in folds]) for seed in range(3)]
        of_frame = [np.mean([slopes[seed, f][k] for seed in range(3)]) for f, n in folds.items() for k in range(n)]
        means.append(np.mean(of_seed))
        variances.append((np.var(of_seed, ddof=1) / 3, 2))
        if len(of_frame) > 1:
            variances.append((np.var(of_frame, ddof=1) / len(of_frame), len(of_frame) - 1))
    total = sum(of for of, _ in variances)
    half = stats.t.ppf(0.975, total**2 / sum(of**2 / free for of, free in variances)) * math.sqrt(total) / 2
    found = difference(score, pairs)
    expected = (np.mean(means), np.mean(means) - half, np.mean(means) + half)
    assert (found.mean, found.low, found.high) == pytest.approx(expected, rel=1e-5)


def test_places_count_alike_whatever_their_number_of_pairs():
    pairs = [pair(3.0, seed=k) for k in range(5)] + [pair(1.0, seed=k, place="phantom") for k in range(2)]
    assert difference("psnr", pairs) == Difference(2.0, 2.0, 2.0, 7)


def test_cells_without_a_score_and_shares_of_nothing_are_left_out():
    nan = pair(math.nan, seed=5)
    assert difference("psnr", [nan, nan]).count == 0 and difference("psnr", []).count == 0
    found = difference("psnr", [nan, pair([1, 3]), pair([2, 2], seed=1)])
    assert found.count == 2 and found.mean == 2
    # No share of nothing; nothing less of nothing is 0.
    found = difference("flow_error_dis", [pair([1, 1], [0, 0]), pair([0, 0], [0, 0], 1), pair([1, 1], [2, 2], 2)])
    assert found.count == 2 and found.mean == 0.25


@pytest.mark.parametrize("spreads", [(0.3, 0.1, 0.1), (0.1, 0.3, 0.1), (0.2, 0.2, 0.2), (0.05, 0.05, 0.3)])
def test_intervals_are_right_as_often_as_they_say(spreads):
    """Three seeds and three folds of three frames: what seeds, frames and both add. 95 of 100, within chance."""
    rng, right = np.random.default_rng(0), 0
    of_seed, of_frame, of_both = spreads
    for _ in range(400):
        values = rng.normal(0, of_seed, (3, 1, 1)) + rng.normal(0, of_frame, (1, 3, 3))
        values = values + rng.normal(0, of_both, (3, 3, 3))
        found = difference("psnr", [pair(values[s, f], None, s, f) for s in range(3) for f in range(3)])
        right += found.low <= 0 <= found.high
    assert right / 400 >= 0.91


SPEC = Spec("t", {"s": SequenceSpec("s", folds=(0, 3))}, {"a": MethodSpec(), "b": MethodSpec()}, seeds=(0, 1))


def results(frames_of_b: dict[int, float], score_of_b: float = 32.0) -> Results:
    """The same values in every cell: a has 30 and 32 dB in frames 1 and 9."""
    cells = {m: [Cell("s", m, None, seed, fold) for seed in (0, 1) for fold in (0, 3)] for m in "ab"}
    scores = {c: {"psnr": 31.0, "num_gaussians": 5} for c in cells["a"]}
    scores |= {c: {"psnr": score_of_b, "num_gaussians": 7} for c in cells["b"]}
    frames = {c: {"psnr": {1: 30.0, 9: 32.0}} for c in cells["a"]} | {c: {"psnr": frames_of_b} for c in cells["b"]}
    return Results(SPEC, scores, frozenset(), frames)


def test_frames_count_where_both_methods_have_the_same():
    found = results({9: 34.0, 1: 30.0}).difference("psnr", "b", "a", "s")  # in any order: better by 0 and 2
    low, high = stats.t.interval(0.95, 1, 1, 1)
    assert (found.mean, found.low, found.high, found.over_frames) == pytest.approx((1, low, high, True))


@pytest.mark.parametrize(("frames", "score"), [({1: 30.0}, 30.0), ({1: 30.0, 17: 34.0}, 32.0), ({}, 32.0)])
def test_other_frames_are_not_compared(frames, score):
    found = results(frames, score).difference("psnr", "b", "a", "s")
    assert (found.mean, found.low, found.high, found.over_frames) == (score - 31, score - 31, score - 31, False)


def test_a_score_that_is_not_the_mean_of_its_frames_is_taken_as_it_is():
    found = results({1: 30.0, 9: 34.0}, 33.0).difference("psnr", "b", "a", "s")
    assert (found.mean, found.low, found.high, found.over_frames) == (2, 2, 2, False)


def test_scores_of_the_scene_have_no_frames():
    found = results({1: 30.0, 9: 34.0}).difference("num_gaussians", "b", "a", "s")
    assert found.count == 4 and not found.over_frames


def test_values_of_frames_are_read_from_the_folders_of_cells(tmp_path):
    """A cell whose folder has none, of an earlier version or a plugin, counts with its score."""
    done = {}
    for seed in (0, 1):
        for method, add in (("a", 0.0), ("b", 1.0 + seed)):
            cell = Cell("s", method, None, seed)
            done[cell] = tmp_path / cell.name.replace("/", "-")
            done[cell].mkdir()
            rows = [{"index": i, "time": i / 20, "psnr": 30 + i + add} for i in (1, 9)] + [{"index": 17, "time": 0.85}]
            (done[cell] / "metrics.json").write_text(json.dumps({"scores": {"psnr": 35 + add}}))
            if seed == 0:
                (done[cell] / "per_frame.json").write_text(json.dumps(rows))
    assert frames_of(done[Cell("s", "a", None, 0)]) == {"psnr": {1: 31.0, 9: 39.0}}
    assert frames_of(done[Cell("s", "a", None, 1)]) == {}
    spec = replace(SPEC, sequences={"s": SequenceSpec("s")})
    pairs = Results.of(Matrix(spec, tmp_path, done)).pairs("psnr", "b", "a")
    assert [p.ours.tolist() for p in pairs] == [[32.0, 40.0], [37.0]]
    assert [(p.place, p.seed, p.frames) for p in pairs] == [(("s", None), 0, (1, 9)), (("s", None), 1, (-1,))]
