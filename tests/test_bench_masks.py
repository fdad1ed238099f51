"""`endoprior bench masks OUT`: networks without each set, kept and resumed; the table, the pictures, the bars."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from endoprior.cli import main
from endoprior.data.images import read_color
from endoprior.phantom import PhantomConfig
from endoprior.tool_masks import network as weights
from endoprior_studies.tool_training import footage, leave_one_out
from endoprior_studies.tool_training.benchmark import Counts, SetScore
from endoprior_studies.tool_training.composites import IGNORED
from endoprior_studies.tool_training.leave_one_out import Row, Training, network_without, weights_file, write_report


def made_up_set(root):
    """Three red frames with a gray bar, and an ignored corner."""
    for i in range(3):
        rgb_u8 = np.full((60, 80, 3), (150, 60, 50), np.uint8)
        label = np.zeros((60, 80), np.uint8)
        label[20:30, : 40 + 5 * i] = 1
        rgb_u8[label == 1] = 110
        label[:5, :5] = IGNORED
        yield f"clip {i}", rgb_u8, label


@pytest.fixture
def sets(monkeypatch):
    """Two sets that may be trained on, one that may not, one phantom."""
    named = dict.fromkeys(("first", "second", "wild"), made_up_set)
    for module in (footage, leave_one_out):
        monkeypatch.setattr(module, "SETS", named)
    monkeypatch.setattr(leave_one_out, "TRAINED", ("first", "second"))
    config = PhantomConfig(frames=2, width=64, height=64, side_views=False)
    monkeypatch.setattr(leave_one_out, "phantom_sets", lambda: {"phantom: graspers": (config,)})


def test_the_clips_must_be_there(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ENDOPRIOR_DATA", str(tmp_path))
    assert main(["bench", "masks", str(tmp_path / "OUT")]) == 2
    assert "ENDOPRIOR_DATA" in capsys.readouterr().err and not (tmp_path / "OUT").exists()
    assert main(["bench", "masks", str(tmp_path / "OUT"), "--steps", "0"]) == 2


def test_every_set_is_scored_by_a_network_that_has_not_seen_it(sets, tmp_path, monkeypatch, capsys):
    seen = []

    def fit(frames, steps, seed, **others):
        seen.append(len(frames))
        return weights.ToolNetwork()

    monkeypatch.setattr(leave_one_out, "fit", fit)
    (tmp_path / "vocalfolds").mkdir()
    monkeypatch.setenv("ENDOPRIOR_DATA", str(tmp_path))
    out = tmp_path / "OUT"
    assert main(["bench", "masks", str(out), "--steps", "1", "--write-weights", str(tmp_path / "w")]) == 0
    assert seen == [1, 1, 2]  # without the first, without the second, with both
    report = json.loads((out / "masks.json").read_text())
    networks = [(row["set"], row["network"]) for row in report["rows"]]
    assert networks == [("first", "first"), ("second", "second"), ("wild", "all"), ("phantom: graspers", "all")]
    assert (tmp_path / "w").read_bytes() == weights_file(out, "all").read_bytes()
    assert read_color(out / "masks.png").shape == (4 * 240, 3 * 320, 3)
    assert main(["bench", "masks", str(out), "--steps", "1"]) == 0 and len(seen) == 3  # kept


def test_a_network_is_trained_once(sets, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(leave_one_out, "fit", lambda *a, **b: calls.append(a) or weights.ToolNetwork())
    for _ in range(2):
        network_without(tmp_path, tmp_path, "first", Training(1, 0), print)
    assert len(calls) == 1 and weights_file(tmp_path, "first").name == "without_first.safetensors"


def test_every_network_starts_from_the_pretrained_weights(sets, tmp_path, monkeypatch):
    starts = []
    monkeypatch.setattr(leave_one_out, "fit", lambda *a, start, **b: starts.append(start) or weights.ToolNetwork())
    given = weights.ToolNetwork()
    for left_out in ("first", "all"):
        network_without(tmp_path, tmp_path, left_out, Training(1, 0, given), print)
    assert starts == [given, given]


def test_the_table_names_worst_and_mean(tmp_path):
    counts = [Counts(50, 100, 100, 20, 1000, 10), Counts(90, 100, 100, 0, 1000, 0, 4, 1)]
    table = [Row(name, "all", SetScore(each, ())) for name, each in zip("ab", counts, strict=True)]
    table.append(Row("a: part", "all", SetScore(counts[0], ()), is_part=True))
    text = write_report(tmp_path, table, {"steps": 5}).read_text()
    assert "| missed core | 20.0% | 10.0% | 10.0% | 5.0% |" in text
    assert "| false area | 1.0% | 3.0% | 0.5% | 1.5% |" in text
    assert "| false frames | 25.0% | 2.0% | 25.0% | 2.0% |" in text
    rows = json.loads((tmp_path / "masks.json").read_text())["rows"]
    assert rows[0]["false_frames"] is None and not math.isnan(rows[1]["false_frames"])
