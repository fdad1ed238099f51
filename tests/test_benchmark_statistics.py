"""Means, paired differences, verdicts and tables against numbers worked out by hand."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest

from endoprior_studies.report import change, claims_section
from endoprior_studies.results import Results
from endoprior_studies.spec import Cell, ClaimSpec, MethodSpec, SequenceSpec, Spec
from endoprior_studies.statistics import Difference, Pair, difference, gains, summary, verdict
from endoprior_studies.tables import csv_lines, latex, markdown, number, score_table, with_training


def test_summary_by_hand():
    found = summary([1.0, 2.0, 6.0, math.nan])
    assert (found.mean, found.count) == (3.0, 3) and found.std == pytest.approx(math.sqrt(7))
    assert math.isnan(summary([4.0]).std) and summary([4.0]).mean == 4
    assert summary([]).count == 0


def test_gains_are_positive_where_better():
    np.testing.assert_allclose(gains("psnr", [33.0], [30.0]), [3.0])
    np.testing.assert_allclose(gains("flow_error_dis", [0.5], [1.0]), [0.5])
    np.testing.assert_allclose(gains("depth_rmse_mm", [3.0], [2.0]), [-0.5])
    np.testing.assert_allclose(gains("track_tear_rate", [0.25], [0.0]), [-0.25])
    np.testing.assert_allclose(gains("num_large_scale", [0.0], [5.0]), [5.0])
    np.testing.assert_allclose(gains("ate_mm", [2.0, 0.0, 1.0], [0.0, 0.0, 2.0]), [np.nan, 0.0, 0.5])


def test_changes_in_words():
    found = Difference(0.031, 0.01, 0.052, 3)
    assert change("flow_error_dis", found) == "+3.1 % [+1.0, +5.2]"
    assert change("psnr", found) == "+0.03 dB [+0.01, +0.05]"
    assert change("ssim", found) == "+0.0310 [+0.0100, +0.0520]"
    assert change("num_large_scale", Difference(-4.0, math.nan, math.nan, 1)) == "-4"
    assert change("psnr", Difference(math.nan, math.nan, math.nan, 0)) == "-"


def pairs(differences) -> list[Pair]:
    """Seeds of one value each with these differences."""
    return [Pair("clip", seed, np.array([value]), np.zeros(1), (0,)) for seed, value in enumerate(differences)]


def test_one_seed_says_nothing_and_two_hardly_anything():
    found = difference("psnr", pairs([0.2, math.nan]))
    assert found.count == 1 and found.mean == 0.2 and math.isnan(found.low)
    for few in (found, difference("psnr", pairs([0.2, 0.3]))):  # 0.25 +- 0.64 for two
        assert verdict(few, "better", 0) == "cannot be told"
    assert verdict(difference("psnr", pairs([0.2, 0.3, 0.25])), "better", 0) == "holds"


@pytest.mark.parametrize(
    ("low", "high", "expect", "by", "said"),
    [
        (0.28, 0.4, "better", 0.27, "holds"),
        (0.2, 0.4, "better", 0.27, "cannot be told"),
        (0.1, 0.2, "better", 0.27, "does not hold"),
        (0.01, 0.1, "better", 0.0, "holds"),
        (0.0, 0.0, "better", 0.0, "does not hold"),
        (-0.1, 0.1, "better", 0.0, "cannot be told"),
        (0.0, 0.1, "no worse", 0.0, "holds"),
        (-0.01, 0.1, "no worse", 0.02, "holds"),
        (-0.05, -0.03, "no worse", 0.02, "does not hold"),
        (-0.01, 0.01, "no effect", 0.02, "holds"),
        (0.03, 0.05, "no effect", 0.02, "does not hold"),
        (-0.01, 0.05, "no effect", 0.02, "cannot be told"),
    ],
)
def test_verdicts(low, high, expect, by, said):
    assert verdict(Difference((low + high) / 2, low, high, 6), expect, by) == said


def results() -> Results:
    """Two methods, one sequence, three seeds; `b` has one seed only in `lpips`."""
    spec = Spec(
        title="t",
        sequences={"s": SequenceSpec(path="s")},
        methods={"a_1": MethodSpec(), "b": MethodSpec(label="B & co")},
        seeds=(0, 1, 2),
        scores=("psnr", "flow_error_dis", "num_gaussians", "lpips", "fps"),
        claims=(ClaimSpec("psnr", "b", "a_1"),),
    )
    scores = {}
    for seed in range(3):
        scores[Cell("s", "a_1", None, seed)] = {"psnr": 30 + seed, "flow_error_dis": 0.5, "num_gaussians": 12345}
        scores[Cell("s", "b", None, seed)] = {"psnr": 31 + seed, "flow_error_dis": 0.25, "num_gaussians": 9000}
    scores[Cell("s", "b", None, 0)]["lpips"] = 0.0414
    return Results(spec, scores)


def test_table_ranks_rounds_and_leaves_out_what_nobody_has():
    table = score_table(results(), "s")
    assert len(table.columns) == 4  # nobody has fps
    assert [name for name, _ in table.rows] == ["a_1", "B & co"]
    (_, a), (_, b) = table.rows
    assert [e.text for e in a] == ["31.0 ± 1.0", "0.5000 ± 0.0000", "12,345 ± 0", "-"]
    assert [e.rank for e in a] == [2, 2, 0, 0] and [e.rank for e in b] == [1, 1, 0, 0]
    assert b[3].text == "0.0414"


def test_training_psnr_stands_beside_that_of_held_out_frames():
    measured = results()
    scores = {cell: {**values, "psnr_train": 40.0} for cell, values in measured.scores.items()}
    assert score_table(replace(measured, scores=scores), "s").columns[:2] == ["PSNR, dB", "training PSNR, dB"]
    assert with_training(["ssim", "psnr_tissue", "fps"]) == ["ssim", "psnr_tissue", "psnr_train", "fps"]
    assert with_training(["ssim"]) == ["ssim"] and with_training(["psnr", "psnr_train"]) == ["psnr", "psnr_train"]


def test_lengths_on_a_sequence_of_relative_depth_are_not_called_mm():
    measured = results()
    scores = {cell: {**values, "depth_rmse_mm": 1.0} for cell, values in measured.scores.items()}
    spec = replace(measured.spec, scores=("psnr", "depth_rmse_mm"))
    assert score_table(Results(spec, scores), "s").columns == ["PSNR, dB", "depth RMSE, mm"]
    assert score_table(Results(spec, scores, frozenset({"s"})), "s").columns == ["PSNR, dB", "depth RMSE, rel."]


def test_markdown_and_latex_mark_best_and_second():
    table = score_table(results(), "s")
    assert markdown(table).splitlines()[2] == "| a_1 | <u>31.0 ± 1.0</u> | <u>0.5000 ± 0.0000</u> | 12,345 ± 0 | - |"
    assert markdown(table).splitlines()[3].startswith("| B & co | **32.0 ± 1.0** |")
    text = latex(table)
    assert r"a\_1 & \underline{31.0 $\pm$ 1.0}" in text and r"B \& co & \textbf{32.0 $\pm$ 1.0}" in text
    assert [word for word in (r"\toprule", r"\midrule", r"\bottomrule") if word in text] == [
        r"\toprule",
        r"\midrule",
        r"\bottomrule",
    ]
    assert "12{,}345" in text and text.count(r"\\") == 3


def test_digits_follow_the_spread():
    assert number(summary([10.0, 10.2])) == "10.10 ± 0.14"
    assert number(summary([1000.0, 1200.0])) == "1,100 ± 141"
    assert number(summary([])) == "-"


def test_csv_has_every_value():
    rows = list(csv.DictReader(io.StringIO(csv_lines(results()))))
    assert len(rows) == 19
    first = {"sequence": "s", "method": "a_1", "budget": "", "seed": "0", "fold": "0", "score": "psnr", "value": "30"}
    assert rows[0] == first


def test_a_claim_is_checked_on_each_sequence():
    """Better on one and worse on another by the same: two opposite verdicts, and together no difference."""
    one = results()
    claim, other = one.spec.claims[0], {"a_1": "b", "b": "a_1"}
    turned = {replace(cell, sequence="t", method=other[cell.method]): value for cell, value in one.scores.items()}
    spec = replace(one.spec, sequences={name: SequenceSpec(path=name) for name in ("s", "t", "empty")})
    both = Results(spec, one.scores | turned)
    found = {name: (said, own.count, own.mean) for name, (own, said) in both.check(claim).items()}
    assert found == {"s": ("holds", 3, 1.0), "t": ("does not hold", 3, -1.0)}
    assert both.together(claim).mean == 0 and both.together(claim).count == 6


def test_claims_of_which_nothing_was_measured_are_one_line():
    one = results()
    others = [ClaimSpec(score, "b", "a_1") for score in ("ssim", "ssim", "depth_rmse_mm")]
    _, lines, _ = claims_section(Results(replace(one.spec, claims=(*one.spec.claims, *others)), one.scores), "##")
    held, missing = lines.split("\n")
    assert held.startswith("- B & co") and held.endswith("s: **holds**, +1.00 dB [+1.00, +1.00].")
    assert missing == "- Not measured: SSIM (claims: 2); depth RMSE, mm (claims: 1)."
