"""Benchmarks under the protocols of other papers: each has tables of its own, and cells know their protocols."""

from __future__ import annotations

import csv
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.data.images import save_png
from endoprior_studies.execute import Outcome
from endoprior_studies.matrix import run_matrix
from endoprior_studies.report import write_report
from endoprior_studies.spec_file import load_spec
from endoprior_studies.worker import work


def write_pictures(folder, sequence, noise: int) -> None:
    """The test frames with noise of so many gray levels."""
    folder.mkdir(parents=True)
    for i in sequence.indices("test"):
        change = np.random.default_rng(i).integers(-noise, noise + 1, sequence.frame(i).rgb_u8.shape)
        save_png(folder / f"{i:06d}.png", np.clip(sequence.frame(i).rgb_u8 + change, 0, 255).astype(np.uint8))


@pytest.fixture
def spec_file(tmp_path, tiny_sequence):
    """Two methods whose pictures are there for two seeds, on one sequence with `gt_masks/` and one without."""
    shutil.copytree(tiny_sequence, tmp_path / "plain")
    shutil.copytree(tiny_sequence / "masks", tiny_sequence / "gt_masks")
    sequence = load_sequence(tiny_sequence)
    for name, noise in (("good", 5), ("bad", 20)):
        for seed in (0, 1):
            write_pictures(tmp_path / name / str(seed), sequence, noise + seed)

    def write(**changes):
        values = {
            "title": "Protocols",
            "sequences": {"tools": {"path": "tiny"}, "plain": {"path": "plain"}},
            "methods": {
                name: {"pictures": dict.fromkeys(("tools", "plain"), f"{name}/{{seed}}")} for name in ("good", "bad")
            },
            "seeds": [0, 1],
            "scores": ["psnr_tissue", "psnr"],
            "protocols": ["endogs", "surgicalgaussian"],
            "figures": [],
        }
        (tmp_path / "spec.yaml").write_text(yaml.safe_dump(values | changes))
        return tmp_path / "spec.yaml"

    return write


def here(jobs):
    """Run the jobs in this process."""
    for job in jobs:
        work(job)
        yield Outcome(job, 0.0, "")


def test_each_protocol_has_tables_of_its_own(tmp_path, spec_file):
    matrix = run_matrix(load_spec(spec_file()), tmp_path / "out", here)
    assert len(matrix.done) == 8 and not matrix.missing
    text = write_report(matrix, tmp_path / "out").read_text()
    ours, rest = text.split("## Protocol endogs\n")
    endogs, surgical = rest.split("## Protocol surgicalgaussian\n")
    assert ours.count("| method | tissue PSNR, dB | PSNR, dB |") == 4, "a table and its differences for each sequence"
    assert (
        endogs.count("| method | PSNR, dB | SSIM |") == 2 and "As published: split: all frames but the first" in endogs
    )
    assert "tools, scored here: split: test, 2 frames;" in endogs and "mask folder: gt_masks; rows: all 40;" in endogs
    assert "plain, scored here:" in endogs and "mask folder: masks; rows: all 40;" in endogs
    assert surgical.count("| method | PSNR, dB | SSIM |") == 1, "one sequence has no gt_masks"
    assert "Not computed on plain: PSNR, SSIM, LPIPS; `results.json` has" in surgical and "12 masked" in surgical
    assert str(tmp_path) not in text, "the report may be published"
    assert "`tags`" not in text
    folder = next(folder for cell, folder in matrix.done.items() if (cell.sequence, cell.method) == ("tools", "good"))
    stored = json.loads((folder / "metrics.json").read_text())
    assert set(stored["protocols"]) == {"endogs", "surgicalgaussian"}
    values = [
        json.loads((folder / "metrics.json").read_text())["protocols"]["endogs"]["scores"]["psnr"]
        for cell, folder in matrix.done.items()
        if (cell.sequence, cell.method) == ("tools", "good")
    ]
    assert f"| good | **{np.mean(values):.1f}" in endogs
    rows = list(csv.DictReader(io.StringIO((tmp_path / "out" / "results.csv").read_text())))
    names = {row["score"] for row in rows}
    assert {"psnr", "endogs/psnr", "endogs/ssim", "surgicalgaussian/psnr"} <= names
    latex = (tmp_path / "out" / "results.tex").read_text()
    assert "% tools, endogs" in latex and "% plain, surgicalgaussian" not in latex and latex.count("% tools\n") == 1


def test_protocols_belong_to_the_cell_and_without_them_nothing_changes(tmp_path, spec_file):
    def keys(**changes):
        jobs = []
        run_matrix(load_spec(spec_file(**changes)), tmp_path / "out", lambda found: iter(jobs.extend(found) or []))
        return {job.name: (job.key, job.protocols) for job in jobs}

    with_two, other_order = keys(), keys(protocols=["surgicalgaussian", "endogs"])
    none = keys(protocols=[])
    assert {k: v[0] for k, v in with_two.items()} == {k: v[0] for k, v in other_order.items()}
    assert all(with_two[name][0] != none[name][0] and none[name][1] == () for name in none)


@pytest.mark.parametrize(
    ("protocols", "said"),
    [(["endonurf"], "protocols"), ("endonerf", "protocols"), (["endonerf", "endonerf"], "expected different names")],
)
def test_bad_protocols_are_named(spec_file, protocols, said):
    with pytest.raises(InputError, match=said) as caught:
        load_spec(Path(spec_file(protocols=protocols)))
    assert "\n" not in str(caught.value)
