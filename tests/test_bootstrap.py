"""Intervals over pairs and frames: closed forms, a slow loop, what is resampled, and how often they are right."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from endoprior.experiments import statistics
from endoprior.experiments.matrix import Matrix, frames_of
from endoprior.experiments.report import resampled
from endoprior.experiments.results import Results
from endoprior.experiments.spec import Cell, MethodSpec, SequenceSpec, Spec
from endoprior.experiments.statistics import Difference, Pair, difference, gains


def pair(ours, theirs=None, frames=None) -> Pair:
    """Values of frames; theirs are 0 where not given."""
    ours = np.atleast_1d(np.asarray(ours, float))
    return Pair(ours, np.zeros_like(ours) if theirs is None else np.atleast_1d(np.asarray(theirs, float)), frames)


def random_pairs(rng: np.random.Generator, nums: list[int]) -> list[Pair]:
    """Pairs of so many frames; two of each share their frames."""
    return [pair(rng.uniform(1, 2, n), rng.uniform(1, 2, n), frames=k // 2) for k, n in enumerate(nums)]


def test_frames_of_equal_pairs_are_drawn_once():
    """Two frames, better by 0 and by 1: a draw is 0, 1/2 or 1 in the ratio 1 : 2 : 1, however many seeds show them."""
    same = difference("psnr", [pair([0, 1], frames="s")] * 8)
    assert (same.mean, same.low, same.high, same.count, same.over_frames) == (0.5, 0, 1, 8, True)
    own = difference("psnr", [pair([0, 1], frames=k) for k in range(8)])
    assert own.mean == 0.5 and 0 < own.low < 0.3 and 0.7 < own.high < 1


def test_relative_differences_are_those_of_means_over_the_drawn_frames():
    """Errors (1, 3) against (2, 4) are better by 1/3, not by the mean of 1/2 and 1/4; the draws are 1/2, 1/3, 1/4."""
    found = difference("flow_error_dis", [pair([1, 3], [2, 4], "s")] * 3)
    assert (found.mean, found.low, found.high) == pytest.approx((1 / 3, 1 / 4, 1 / 2))


@pytest.mark.parametrize("score", ["psnr", "flow_error_dis"])
def test_with_one_frame_in_each_cell_it_is_the_interval_over_pairs(score):
    rng = np.random.default_rng(1)
    for count in (2, 3, 9):
        ours, theirs = rng.uniform(1, 2, (2, count))
        values = gains(score, ours, theirs)
        drawn = np.random.default_rng(7).integers(count, size=(statistics.RESAMPLES, count))
        tail = 50 * (1 - statistics.CONFIDENCE)
        low, high = np.percentile(values[drawn].mean(1), (tail, 100 - tail))
        for frames in (None, "one frame"):
            pairs = [pair(a, b, frames) for a, b in zip(ours, theirs, strict=True)]
            assert difference(score, pairs, 7) == Difference(values.mean(), low, high, count)


@pytest.mark.parametrize("score", ["psnr", "depth_rmse_mm"])
@pytest.mark.parametrize("nums", [[3, 3, 3, 3], [4, 4, 1, 1, 2, 2]])
def test_a_slow_loop_draws_the_same(score, nums, monkeypatch):
    monkeypatch.setattr(statistics, "RESAMPLES", 60)
    pairs = random_pairs(np.random.default_rng(2), nums)
    rng = np.random.default_rng(5)
    chosen = rng.integers(len(pairs), size=(60, len(pairs)))
    draws = [rng.integers(num, size=(60, num)) for num in nums[::2]]
    means = []
    for r in range(60):
        total = 0.0
        for k in chosen[r]:
            num = nums[k]
            frames = draws[k // 2][r]
            ours = sum(pairs[k].ours[i] for i in frames) / num
            theirs = sum(pairs[k].theirs[i] for i in frames) / num
            total += ours - theirs if score == "psnr" else (theirs - ours) / theirs
        means.append(total / len(pairs))
    found = difference(score, pairs, 5)
    assert (found.low, found.high) == pytest.approx(tuple(np.percentile(means, (2.5, 97.5))))


def test_more_frames_widen_and_never_move_the_mean():
    rng = np.random.default_rng(3)
    for nums in ([4] * 6, [19] * 4):
        pairs = random_pairs(rng, nums)
        alone = [pair(p.ours.mean(), p.theirs.mean()) for p in pairs]
        with_frames, without = difference("psnr", pairs), difference("psnr", alone)
        assert with_frames.mean == pytest.approx(without.mean)
        assert with_frames.high - with_frames.low > without.high - without.low


def test_cells_without_a_score_and_shares_of_nothing_are_left_out():
    nan = pair([math.nan])
    assert difference("psnr", [nan, nan]).count == 0 and difference("psnr", []).count == 0
    found = difference("psnr", [nan, pair([1, 3], frames=0), pair([2, 2], frames=0)])
    assert found.count == 2 and found.low == 1 and found.high == 3  # twice the first pair and one frame: 1 of 16
    # A third of the draws of a pair have no error of theirs to take a share of.
    some = difference("flow_error_dis", [pair([1, 1], [0, 2], "s")] * 3)
    assert (some.mean, some.low, some.high) == pytest.approx((0, 0, 0.5))


def test_intervals_are_right_about_as_often_as_they_say(monkeypatch):
    """Three seeds and three folds of three frames, which differ more than seeds do: over pairs alone 62 of 100."""
    monkeypatch.setattr(statistics, "RESAMPLES", 400)
    rng = np.random.default_rng(0)
    right = np.zeros(2)
    for k in range(200):
        of_frame = rng.normal(0, 0.3, (1, 3, 3))
        values = rng.normal(0, 0.1, (3, 3, 1)) + of_frame + rng.normal(0, 0.1, (3, 3, 3))
        pairs = [pair(values[s, f], frames=f) for s in range(3) for f in range(3)]
        for j, own in enumerate((pairs, [pair(p.ours.mean()) for p in pairs])):
            found = difference("psnr", own, k)
            right[j] += found.low <= 0 <= found.high
    assert right[0] / 200 >= 0.88 and right[1] / 200 < 0.75


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
    assert (found.mean, found.low, found.high, found.over_frames) == (1, 0, 2, True)


@pytest.mark.parametrize(("frames", "score"), [({1: 30.0}, 30.0), ({1: 30.0, 17: 34.0}, 32.0), ({}, 32.0)])
def test_other_frames_are_not_compared(frames, score):
    found = results(frames, score).difference("psnr", "b", "a", "s")
    assert (found.mean, found.low, found.high, found.over_frames) == (score - 31, score - 31, score - 31, False)


def test_a_score_that_is_not_the_mean_of_its_frames_is_taken_as_it_is():
    found = results({1: 30.0, 9: 34.0}, 33.0).difference("psnr", "b", "a", "s")
    assert (found.mean, found.low, found.high, found.over_frames) == (2, 2, 2, False)


def test_scores_of_the_scene_are_resampled_over_pairs():
    found = results({1: 30.0, 9: 34.0}).difference("num_gaussians", "b", "a", "s")
    assert found.count == 4 and not found.over_frames


def test_the_report_says_over_what():
    some = results({})
    assert resampled(some, "s", []) == "seeds and folds"
    assert resampled(some, "s", ["psnr", "ssim"]) == "seeds and folds; of PSNR, SSIM also over their frames"
    one = replace(SPEC, sequences={"s": SequenceSpec("s")}, budgets=(100, 200))
    assert resampled(replace(some, spec=one), "s", []) == "budgets and seeds"
    assert resampled(replace(some, spec=replace(one, budgets=(), seeds=(4,))), "s", []) == "seeds"


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
    assert pairs[0].frames == ("s", (1, 9)) and pairs[1].frames is None
