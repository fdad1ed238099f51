"""The registry of scores: names are unique, and docs/scores.md says the same as the registry."""

from pathlib import Path

import pytest

from endoprior.cli.evaluate import score_table
from endoprior.evaluation.registry import all_scores, scorers

PAGE = Path(__file__).parents[1] / "docs" / "scores.md"
OF_MASKS = {name: score for name, score in all_scores().items() if score.group == "masks"}
OF_SCENES = {name: score for name, score in all_scores().items() if score.group != "masks"}
NAMED = {
    n: s
    for n, s in OF_SCENES.items()
    if not (n.startswith(("track_", "deformation_")) and n.endswith(("_dis", "_still")))
}
"""Scores of a scene that the page names; it says of all others together what they are."""
LISTED = {name: score for name, score in NAMED.items() if score.in_summary}
"""Those with a row of their own; the site shows rows of the others."""
BETTER = {True: " \u2191", False: " \u2193", None: ""}


def test_every_score_has_one_scorer():
    names = [score.name for scorer in scorers().values() for score in scorer.SCORES]
    assert len(names) == len(set(names)) == len(OF_SCENES) and len(all_scores()) == len(OF_SCENES) + len(OF_MASKS)


@pytest.mark.parametrize("scores", [LISTED, OF_MASKS], ids=["of a scene", "of masks"])
def test_the_page_lists_every_score(scores):
    rows = [
        f"| `{s.name}` | {s.label} | {(s.unit + BETTER[s.higher_is_better]).strip() or '-'} | {s.description} |"
        for s in scores.values()
    ]
    assert "\n".join(rows) + "\n\n" in PAGE.read_text(encoding="utf-8"), "expected this table:\n" + "\n".join(rows)


def test_the_page_names_every_other_score():
    page = PAGE.read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in NAMED)


def test_every_score_has_a_group_and_a_meaning():
    for score in all_scores().values():
        assert score.group != "other" and score.description.endswith(".") and len(score.hint) <= 40


def test_the_printed_table_fits_a_page_and_says_which_way_is_better():
    table = score_table(dict.fromkeys(OF_SCENES, 1.0), {})
    assert len(table) <= 39 and all(len(line) <= 90 for line in table)
    by_label = {line[10:29].strip(): line for line in table}
    assert "1.00 dB \u2191  above 35 dB" in by_label["tissue PSNR"] and "0 is identical" in by_label["LPIPS"]
    assert by_label["depth RMSE"].startswith("  depth") and "1.000 mm \u2193" in by_label["depth RMSE"]
    assert "strict PSNR" not in by_label and "\u2191" not in by_label["Gaussians"]
    groups = [line[2:9].strip() for line in table if line[2:9].strip()]
    assert groups == ["image", "depth", "motion", "model", "speed"]


def test_scores_that_lack_the_same_package_are_one_line():
    reason = "torchvision is not installed."
    skipped = {"flow_error": reason, "lpips": reason, "lpips_squeeze": reason, "psnr_behind_tool": "no truth"}
    assert score_table({}, skipped) == [
        f"  not computed: flow error, LPIPS: {reason}",
        "  not computed: PSNR behind tool: no truth",
    ]


def test_a_score_that_is_there_is_printed_beside_the_published_one_that_is_not():
    scores, skipped = {"flow_error_raft_small": 0.25, "lpips_squeeze": 0.125}, {"flow_error": "no weights"}
    assert score_table(scores, skipped) == [
        "  motion  flow error (RAFT-small)   0.250 px \u2193",
        "  not computed: flow error: no weights",
    ]
    assert "LPIPS (squeeze)" in score_table(scores, {"lpips": "no weights"})[0]
    published = {"flow_error": 0.5, "lpips": 0.5}
    assert score_table(scores | published, {}) == score_table(published, {})


def test_values_are_shown_with_their_unit():
    shown = {"psnr": 31.267, "ssim": 0.95, "num_gaussians": 20_000, "fps": 45.01}
    texts = [all_scores()[name].text(value) for name, value in shown.items()]
    assert texts == ["31.27 dB", "0.9500", "20,000", "45.0 frames/s"]
    assert all_scores()["psnr"].heading() == "PSNR, dB" and all_scores()["ssim"].heading() == "SSIM"


def test_lengths_of_relative_depth_are_not_called_mm():
    rmse, instability = all_scores()["depth_rmse_mm"], all_scores()["depth_instability_mm"]
    assert rmse.text(1.1, relative=True) == "1.100 rel." and instability.heading(True) == "depth instability, rel."
    table = score_table(dict.fromkeys(OF_SCENES, 1.0), {}, relative=True)
    in_mm = [line for line in table if " mm" in line]
    assert len(in_mm) == 1 and "camera path error" in in_mm[0], "that is measured in the truth, after alignment"
    assert table[-1].startswith("  rel.: the scale of the depth is unknown.")
    without = score_table({"psnr": 30.0, "ssim": 0.9, "flow_error_dis": 1.0}, {}, relative=True)
    assert not any("rel." in line for line in without), "a note on lengths that the table does not have"


def test_references_stand_beside_the_score_that_they_belong_to():
    scores = {"track_delta_avg": 0.9, "track_delta_avg_dis": 0.8, "track_delta_avg_still": 0.25, "track_error_mm": 1.0}
    table = score_table(scores, {})
    assert [line.split("  ")[-1] for line in table] == ["0 follows the tissue", "chained flow 0.800, no motion 0.250"]
    flow = score_table({"flow_error": 1.0, "flow_error_dis": 2.0}, {})  # two scores, not a score and its reference
    assert not any("chained flow" in line for line in flow)
    right = score_table({"right_psnr": 31.0, "right_psnr_warp": 36.444}, {})
    assert len(right) == 1 and right[0].endswith("31.00 dB \u2191  left eye moved by depth 36.44")
    every = score_table(dict.fromkeys(OF_SCENES, 12.3456), {})
    assert all(len(line) <= 90 for line in every)


def test_tracks_have_both_references():
    for name in ("track_delta_avg", "track_average_jaccard", "track_occlusion_accuracy", "track_error_after_hidden_mm"):
        for end in ("dis", "still"):
            reference, score = all_scores()[f"{name}_{end}"], all_scores()[name]
            assert (reference.unit, reference.higher_is_better) == (score.unit, score.higher_is_better)
            assert score.in_summary and not reference.in_summary
