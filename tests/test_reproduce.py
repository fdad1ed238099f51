"""The paper's tables on the user's own copies: folders that are taken, published figures beside ours, the time."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
import time

import pytest
from published_folders import write_endonerf, write_scared

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.evaluation.registry import all_scores
from endoprior.model.presets import preset
from endoprior_studies.matrix import Matrix
from endoprior_studies.results import Results
from endoprior_studies.spec import Cell, SpecSelection
from endoprior_studies.spec_file import find_spec, load_spec, load_specs, spec_names, specs_of
from endoprior_studies.tables import FIGURES, published_blocks, published_table, rows_of
from endoprior_studies.timing import Speed, parts_of, shortened

TABLES = [name for name in spec_names() if name.startswith("reproduce/")]
SMALL = (40, 32)


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """Folders of pulling and of a SCARED keyframe, small."""
    folder = tmp_path_factory.mktemp("clips")
    return write_endonerf(folder / "pulling", 63, *SMALL), write_scared(folder / "d2", 9, *SMALL)


@pytest.mark.parametrize("name", TABLES)
def test_every_published_row_has_a_method_and_no_method_a_row_that_is_not_published(name):
    spec = load_spec(find_spec(name))
    about = spec.published
    rows = [row for row in rows_of(FIGURES) if (row["source"], row["data"]) == (about.table, about.data)]
    assert {row["method"] for row in rows} == {method.published for method in spec.methods.values()} - {""}
    assert {row["budget"] for row in rows} == {str(budget) for budget in spec.budgets or ("",)}
    columns = {column for row in rows for column, value in row.items() if value} & {*all_scores()}
    assert columns <= {*spec.scores}, "a published score is not asked for"


def test_table_4_and_5_change_one_thing_at_a_time():
    four, five = (load_spec(find_spec(f"reproduce/table{k}")) for k in (4, 5))
    of = {name: five.config(name, "pulling", None, 0) for name in five.methods}
    assert of["released"].replace({"temporal.weight": 0.0}) == of["prior_density"]
    assert of["prior_density"].replace({"density.min_densify_weight": 1.0}) == of["prior_init"]
    of = {name: four.config(name, "pulling", None, 0) for name in four.methods}
    assert of["temporal"].temporal == preset("released").temporal
    for name, left_out in (("no_pairs", "pair_weights"), ("no_distance", "distance")):
        assert of["temporal"].replace({"temporal.without": left_out}) == of[name]


def test_figures_stand_below_the_published_ones_of_the_same_method_and_budget():
    spec = SpecSelection(seeds=(0, 1)).of(load_spec(find_spec("reproduce/table2")))
    cells = {
        Cell(name, "paper", 20_000, seed): {"psnr": 30.0 + 2 * k + seed}
        for k, name in enumerate(("pulling", "cutting"))
        for seed in (0, 1)
    }
    table = published_table(Results(spec, cells), spec.published, ["pulling", "cutting"])
    names, psnr = [name for name, _ in table.rows], table.columns.index("PSNR, dB")
    place = names.index("EndoPrior-GS, 20,000: published")
    assert names[place : place + 3] == [
        "EndoPrior-GS, 20,000: published",
        "EndoPrior-GS (released): here",
        "EndoPrior-GS (paper): here",
    ]
    text = [[entry.text for entry in entries][psnr] for _, entries in table.rows[place : place + 3]]
    assert text == ["38.07", "-", "31.50 ± 0.71"]
    alone = published_table(Results(spec, cells), spec.published, ["pulling"])
    assert alone.rows[place + 2][1][psnr].text == "30.50 ± 0.71"


def test_methods_that_take_weeks_run_only_if_they_are_named():
    paths = specs_of(find_spec("reproduce"))
    usual, named = load_specs(paths, {}), load_specs(paths, {}, SpecSelection(("endonerf",), (4,), 30))
    assert all("endonerf" not in spec.methods for spec in usual.values())
    assert {path.stem for path in named} == {"table1", "table1_scared"}
    for spec in named.values():
        assert [*spec.methods] == ["endonerf"] and spec.seeds == (4,) and not spec.claims
        (name, *_) = spec.sequences
        assert spec.config("endonerf", name, None, 4).schedule.total == 30
    with pytest.raises(InputError, match=r"--methods: expected one of .*, got 'nerf'"):
        load_specs(paths, {}, SpecSelection(("nerf",)))


def test_an_estimate_counts_each_part_of_a_schedule(tmp_path):
    cfg = preset("paper")
    assert parts_of(cfg) == (1000, 0, 1000, 2000) and parts_of(preset("endogaussian")) == (1000, 0, 3000, 0)
    assert parts_of(preset("default")) == (0, 450, 0, 900)
    short = cfg.replace(shortened(cfg))
    parts = parts_of(short)
    assert parts == (30, 0, 30, 30)
    (tmp_path / "run").mkdir()
    seconds = {("coarse", 0): 1.0, ("fine", 0): 2.0, ("fine", 30): 5.0}
    lines = [
        {"stage": stage, "iteration": begin + i, "seconds": value if i > 10 else 100.0}
        for (stage, begin), value in seconds.items()
        for i in (10, 20, 30)
    ]
    (tmp_path / "run" / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (tmp_path / "cell.json").write_text(json.dumps({"seconds": 30 * (1 + 2 + 5) + 126.0}))
    speed = Speed.of(tmp_path, parts, 63)
    assert speed.iteration == (1.0, 0.0, 2.0, 5.0) and math.isclose(speed.beside, 2.0)
    assert math.isclose(speed.seconds(parts_of(cfg), 156), 1000 + 1000 * 2 + 2000 * 5 + 156 * 2)
    assert Speed.of(tmp_path, parts, 63) == speed, "a second estimate does not measure again"


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (
            "cutting={pulling}",
            "expected the 156 frames of the published sequence cutting, got 63. Fix: Correct --data cutting",
        ),
        ("pulling={d2}", "images: expected a folder of PNG files"),
        ("d2={pulling}", "frame_data: expected a folder of processed SCARED frames"),
        ("pulling=nowhere", "nowhere"),
        ("pullling={pulling}", "--data pullling: expected one of pulling, cutting"),
    ],
)
def test_a_wrong_folder_is_one_line(clips, tmp_path, capsys, data, said):
    typed = data.format(pulling=clips[0], d2=clips[1])
    assert main(["bench", "reproduce", str(tmp_path / "out"), "--data", typed]) == 2
    text = capsys.readouterr().err
    assert said in text and text.count("\n") == 1 and not (tmp_path / "out").exists()


def test_the_report_says_what_is_missing_and_what_differs(clips, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--data", f"pulling={clips[0]}", "--seeds", "0", "--iterations", "20", "--report-only"]
    assert main(["bench", "reproduce", str(out), *options]) == 0
    assert not (out / "table1_scared").exists(), "no folder of SCARED was given"
    text = (out / "results.md").read_text()
    assert text.count("**Shortened: every method trained 20 iterations") == 5
    assert "Published: means over pulling, cutting; here pulling." in text
    assert "pulling: 40 x 32 pixels; published: 640 x 512." in text
    assert "| EndoGaussian: published | 37.322 |" in text and "EndoGS by its authors: split: all frames but" in text
    assert "EndoPrior-GS: published & 38.071" in (out / "table1" / "results.tex").read_text()
    whole = load_spec(find_spec("reproduce/table1"))
    blocks = published_blocks(Matrix(whole, out), Results(whole, {}), "##")
    assert not any("Shortened" in block for block in blocks) and "here there are none" in blocks[-1]
    assert published_blocks(Matrix(load_spec(find_spec("quick")), out), Results(whole, {}), "##") == []


def finished(out):
    return {path.parent.name: path.stat().st_mtime_ns for path in out.glob("cells/*/cell.json")}


@pytest.mark.slow
def test_the_whole_command_small_killed_and_resumed(clips, tmp_path):
    out = tmp_path / "out"
    words = ["bench", "reproduce", str(out), "--data", f"pulling={clips[0]}", f"d2={clips[1]}", "--seeds", "0"]
    words += ["--iterations", "20", "--methods", "default", "endo4dgs", "--cores", "1"]
    process = subprocess.Popen([sys.executable, "-m", "endoprior", *words], stdout=subprocess.DEVNULL)
    try:
        for _ in range(3000):
            if finished(out):
                break
            time.sleep(0.1)
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    before = finished(out)
    assert 0 < len(before) < 4
    assert main(words) == 0
    assert before.items() <= finished(out).items() and len(finished(out)) == 4
    text = (out / "results.md").read_text()
    row = re.search(r"\| ours \(default\): here \| (\S+) \| (\S+) \| - \| (\S+) \| - \|", text)
    assert row and all(math.isfinite(float(value)) for value in row.groups())
    assert "by `numba` on CPU" in text and "LPIPS: no value here: no weights" in text


@pytest.mark.slow
def test_an_estimate_trains_shortly_and_then_nothing(clips, tmp_path, capsys):
    words = [
        "bench",
        "reproduce/table1",
        str(tmp_path / "out"),
        "--data",
        f"pulling={clips[0]}",
        "--methods",
        "default",
    ]
    assert main([*words, "--estimate"]) == 0
    text = capsys.readouterr().out
    assert re.search(
        r"time on this machine: \d+\.\d h or more for 3 trainings, \d+ at a time \(table1 \d+\.\d h\)", text
    )
    assert re.search(r"disk: about \d+\.\d GB", text)
    assert len(finished(tmp_path / "out")) == 1 and not (tmp_path / "out" / "results.md").exists()
    assert main([*words, "--estimate"]) == 0
    assert "[1/1]" in text and "[1/1]" not in capsys.readouterr().out, "what was measured is kept"


def test_the_page_of_a_spec_has_the_names_that_it_needs_and_what_they_are(capsys):
    assert main(["bench", "reproduce", "--help"]) == 0
    page = capsys.readouterr().out
    assert len(page.splitlines()) <= 45 and max(map(len, page.splitlines()[:-4])) <= 120
    for name, words in (
        ("pulling", "EndoNeRF: pulling_soft_tissues, 63 frames"),
        ("cutting", "EndoNeRF: cutting_tissues_twice, 156 frames"),
        ("d1", "SCARED: dataset_1/keyframe_1, the folder that holds data/"),
        ("d7", "SCARED: dataset_7/keyframe_1, the folder that holds data/"),
    ):
        assert re.search(rf"^  {name} +{re.escape(words)}", page, re.MULTILINE), name
    for name in ("reproduce/table1_scared", "endosurf,", "endogaussian", "--data pulling=FOLDER cutting=FOLDER"):
        assert name in page
    for name in ("quick", "reproduce/table1", "whole/own"):
        assert main(["bench", name, "-h"]) == 0
        assert capsys.readouterr().out.startswith(f"usage: endoprior bench {name} OUT")
