"""How many Gaussians came and went: counts of a plan, lines of the log, and rules that never fired."""

import json
from dataclasses import replace

import torch
from matplotlib.figure import Figure

from endoprior.core.config import ReleasedMethod
from endoprior.model.presets import preset
from endoprior.runs.log import growth_of, iterations_done
from endoprior.runs.report import plot_loss
from endoprior.training.density import DensityStats, plan
from endoprior_studies.matrix import Matrix
from endoprior_studies.report import silent_rules
from endoprior_studies.spec import Cell, MethodSpec, SequenceSpec, Spec


def line(iteration: int, num: int, **more) -> str:
    about = {"stage": "fine", "iteration": iteration, "num_gaussians": num}
    return json.dumps(about | more | {"terms": {}, "seconds": 0.1}) + "\n"


def test_a_plan_counts_what_each_rule_takes():
    stats = DensityStats.zeros(5)
    stats.num_seen += 1
    stats.grad2d_ndc_sum[:] = torch.tensor([1.0, 0, 0, 0, 1])  # the first and the last one grow
    stats.num_valid += 30
    stats.opacity_sum += 30 * 0.006
    stats.score_sum[:] = 30 * torch.tensor([1.0, 1, 0, 1, 1])  # the third one is distrusted
    opacities = torch.tensor([0.5, 0.001, 0.5, 0.5, 0.5])  # the second one is faint
    cfg, released = preset("paper").density, ReleasedMethod(prune_max_scale_mm=40.0)
    found = plan(
        stats, torch.tensor([[1.0] * 3, [1.0] * 3, [1.0] * 3, [50.0] * 3, [50.0] * 3]), opacities, 1e3, cfg, released
    )
    assert found.counts() == {
        "cloned": 1,
        "split": 1,  # the last one is huge, its children are not
        "removed_opacity": 1,
        "removed_size": 1,
        "removed_prior": 1,
    }
    plain = replace(cfg, min_densify_weight=1.0)
    assert "removed_prior" not in plan(stats, torch.ones(5, 3), opacities, 1e3, plain).counts()


def test_growth_is_that_of_all_windows_by_the_log(tmp_path):
    event = {"cloned": 2, "split": 0, "removed_prior": 0}
    text = line(10, 100, window=0) + line(20, 120, window=0, event=event) + line(10, 50, window=1)
    (tmp_path / "log.jsonl").write_text(
        text + line(20, 60, window=1, event=event) + '{"stage": "fi'
    )  # cut short by a crash
    found = growth_of(tmp_path)
    assert (found.first, found.last, found.num_events, found.ratio) == (150, 180, 2, 1.2)
    assert dict(found.changes) == {"cloned": 4, "split": 0, "removed_prior": 0}


def test_there_is_no_growth_without_a_log_or_without_gaussians(tmp_path):
    assert growth_of(tmp_path) is None
    (tmp_path / "log.jsonl").write_text(line(10, 0))
    assert growth_of(tmp_path) is None


def test_iterations_of_stages_and_windows_add_up():
    """Lines are not evenly spaced: events of density control have some of their own."""
    lines = [("coarse", 10), ("coarse", 13), ("coarse", 20), ("fine", 4), ("fine", 10)]
    log = [{"stage": stage, "iteration": iteration, "terms": {"color": 0.5}} for stage, iteration in lines]
    assert iterations_done(log) == [10, 13, 20, 24, 30]
    windows = [line | {"window": k} for k in range(2) for line in log]
    assert iterations_done(windows) == [10, 13, 20, 24, 30, 40, 43, 50, 54, 60] and iterations_done([]) == []
    axis = Figure().subplots()
    plot_loss(axis, windows)
    curve, *borders = axis.lines
    assert [*curve.get_xdata()] == iterations_done(windows) and [line.get_xdata()[0] for line in borders] == [20, 50]
    (entry,) = axis.get_legend().get_texts()
    assert entry.get_text() == "fine stage begins"


def test_the_report_warns_of_rules_that_never_fired(tmp_path):
    spec = Spec("t", {"clip": SequenceSpec(path="x")}, {name: MethodSpec() for name in "abc"}, seeds=(0, 1))
    event = {"cloned": 0, "split": 0, "removed_opacity": 1, "removed_prior": 0}
    logs = {
        ("a", 0): line(10, 5, event=event),
        ("a", 1): line(10, 5, event=event | {"split": 3}),  # one seed suffices
        ("b", 0): line(10, 5, event=event),
        ("c", 0): line(10, 5),
    }
    matrix = Matrix(spec, tmp_path)
    for (method, seed), text in logs.items():
        folder = tmp_path / f"{method}{seed}"
        (folder / "run").mkdir(parents=True)
        (folder / "run" / "log.jsonl").write_text(text)
        matrix.done[Cell("clip", method, None, seed)] = folder
    assert silent_rules(matrix) == [
        "a, clip: the rule prior removed nothing in 2 density events",
        "b, clip: nothing grew, the rule prior removed nothing in 1 density events",
        "c, clip: nothing grew or went in 0 density events",
    ]
