"""The registry of scores: names are unique, and docs/scores.md says the same as the registry."""

from pathlib import Path

from endoprior.evaluation.registry import all_scores, scorers

PAGE = Path(__file__).parents[1] / "docs" / "scores.md"
BETTER = {True: "higher", False: "lower", None: "-"}


def test_every_score_has_one_scorer():
    names = [score.name for scorer in scorers().values() for score in scorer.SCORES]
    assert len(names) == len(set(names)) == len(all_scores())


def test_the_page_lists_every_score():
    rows = [
        f"| `{s.name}` | {s.label} | {s.unit or '-'} | {BETTER[s.higher_is_better]} | {s.description} |"
        for s in all_scores().values()
    ]
    assert "\n".join(rows) + "\n\n" in PAGE.read_text(encoding="utf-8"), "expected this table:\n" + "\n".join(rows)


def test_values_are_shown_with_their_unit():
    shown = {"psnr": 31.267, "ssim": 0.95, "num_gaussians": 20_000, "fps": 45.01}
    texts = [all_scores()[name].text(value) for name, value in shown.items()]
    assert texts == ["31.27 dB", "0.9500", "20,000", "45.0 frames/s"]
    assert all_scores()["psnr"].heading == "PSNR, dB" and all_scores()["ssim"].heading == "SSIM"
