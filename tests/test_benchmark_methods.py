"""Benchmarks of methods that are not presets: plugins, and images of other programs, beside one of ours."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from plugin_packages import EXAMPLE, entry_points, on_path, write_package
from tiny_training import tiny_config

from endoprior import load_sequence
from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config_io import to_dict
from endoprior.data.images import save_png
from endoprior.evaluation.context import NO_SCENE
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.training.gaussian_trainer import GaussianTrainer
from endoprior_studies import method as methods
from endoprior_studies import spec as specs
from endoprior_studies.execute import Outcome
from endoprior_studies.matrix import run_matrix
from endoprior_studies.report import write_report
from endoprior_studies.spec import cells
from endoprior_studies.spec_file import load_spec
from endoprior_studies.worker import work

PHANTOM = {"frames": 10, "width": 48, "height": 40}
METHODS = {
    "nearest": {"method": "nearest-frame"},
    "mean": {"method": "nearest-frame", "set": {"num_frames": 1000}, "label": "Mean image"},
    "theirs": {"pictures": {"ph": "images/run"}, "label": "Theirs"},
    "seeded": {"pictures": {"ph": "images/{seed}"}},
}
VALUES = {
    "title": "Others",
    "sequences": {"ph": {"phantom": PHANTOM}, "other": {"path": "same"}},
    "methods": METHODS,
    "seeds": [0, 1],
    "set": {"schedule.fine_iterations": 5},
    "scores": ["psnr_tissue", "depth_rmse_mm", "flow_error_dis", "mae", "num_gaussians"],
    "figures": ["curves", "frames"],
}


@pytest.fixture(autouse=True)
def example(tmp_path):
    """The example package, installed."""
    write_package(tmp_path / "site", "endoprior-example", entry_points(EXAMPLE))
    with on_path(EXAMPLE, tmp_path / "site"):
        yield


def write_spec(folder: Path, **changes) -> Path:
    path = folder / "spec.yaml"
    path.write_text(yaml.safe_dump(VALUES | changes, sort_keys=False))
    return path


def write_images(folder: Path, data: Path, brighter: int) -> None:
    """The test frames of a sequence, some levels brighter."""
    sequence = load_sequence(data)
    folder.mkdir(parents=True)
    for frame in sequence.frames("test"):
        save_png(folder / f"{frame.index}.png", frame.rgb_u8.clip(0, 255 - brighter) + brighter)


def in_this_process(jobs):
    """An executor that is quick."""
    for job in jobs:
        work(job)
        yield Outcome(job, 0.0)


def test_plugins_and_images_stand_in_the_tables(tmp_path):
    spec, out = load_spec(write_spec(tmp_path)), tmp_path / "out"
    write_phantom(tmp_path / "same", PhantomConfig(**PHANTOM))
    for name, brighter in (("run", 3), ("0", 3), ("1", 6)):
        write_images(tmp_path / "images" / name, tmp_path / "same", brighter)
    write_report(run_matrix(spec, out, in_this_process), out)
    text = (out / "results.md").read_text()
    heads, _, *rows = [line for line in text.split("## ph\n")[1].splitlines() if line.startswith("|")][:6]
    wanted = [
        "tissue PSNR, dB",
        "training PSNR, dB",
        "depth RMSE, mm",
        "flow error (DIS), px",
        "mean absolute error, %",
    ]
    assert heads.startswith(" | ".join(["| method", *wanted]))
    assert [row.split(" | ")[0] for row in rows] == ["| nearest", "| Mean image", "| Theirs", "| seeded"]
    facts = json.loads((out / "results.json").read_text())
    found = {(c["sequence"], c["method"], c["seed"]): c for c in facts["cells"]}
    ph = [key for key in found if key[0] == "ph"]
    assert sorted(key[1:] for key in ph if key[1] in ("theirs", "seeded")) == [
        ("seeded", 0), ("seeded", 1), ("theirs", 0),
    ]  # fmt: skip
    assert found["ph", "theirs", 0]["scores"] == found["ph", "seeded", 0]["scores"]
    assert found["ph", "seeded", 1]["scores"]["mae"] > found["ph", "seeded", 0]["scores"]["mae"]
    assert found["ph", "nearest", 0]["skipped"]["num_gaussians"] == NO_SCENE
    assert "train_seconds" in found["ph", "nearest", 0]["scores"]
    assert found["ph", "theirs", 0]["skipped"]["train_seconds"] == "the images come from another program"
    assert "methods.theirs.pictures: expected other, got no entry" in facts["missing"]["other/theirs/seed0"]
    stored = json.loads((out / "cells" / found["ph", "mean", 1]["folder"] / "metrics.json").read_text())
    assert stored["plugin"] == {
        "name": "nearest-frame", "package": "endoprior-example 1.0", "options": {"num_frames": 1000}, "seed": 1,
    }  # fmt: skip
    write_images(tmp_path / "images" / "other", tmp_path / "same", 9)
    (tmp_path / "images" / "run" / "1.png").write_bytes((tmp_path / "images" / "other" / "1.png").read_bytes())
    jobs = []
    run_matrix(spec, out, lambda found: iter(jobs.extend(found) or []))
    assert [job.name for job in jobs] == ["ph/theirs/seed0"]  # other images are another result, the rest is kept


@pytest.mark.slow
def test_a_preset_a_plugin_and_images_are_compared(tmp_path, make_tiny_sequence):
    data = make_tiny_sequence("tiny")
    write_images(tmp_path / "images", data, 3)
    flat = {"init.motion": "rest", "init.budget": 300, "schedule.coarse_iterations": 0}
    methods = {
        "ours": {"set": flat},
        "nearest": {"method": "nearest-frame"},
        "theirs": {"pictures": {"tiny": "images"}},
    }
    changes = {"sequences": {"tiny": {"path": "tiny"}}, "compare_with": "nearest", "budgets": [200, 300]}
    spec = write_spec(tmp_path, methods=methods, seeds=[0], **changes)
    assert main(["bench", str(spec), str(tmp_path / "out"), "--cores", "2"]) == 0
    text = (tmp_path / "out" / "results.md").read_text()
    rows = [line.split(" | ")[0] for line in text.splitlines() if line.startswith("| ") and "---" not in line]
    assert rows[:5] == ["| method", "| ours, 200", "| nearest", "| theirs", "| ours, 300"]
    assert "frames-tiny.png" in text and "- `backend`: numba" in text
    (scene, _) = (tmp_path / "out").glob("cells/*/run/scene.safetensors")
    assert not (scene.parent / "checkpoint.safetensors").exists()


def test_a_method_may_return_a_scene(tmp_path, make_tiny_sequence, monkeypatch):
    """A scene gets all scores, and is saved."""

    class Untrained:
        options = tiny_config("basis")

        def train(self, sequence, options, *, seed, out):
            out.mkdir()
            trainer = GaussianTrainer(sequence, options)
            trainer.start()
            return trainer.scene()

    make_tiny_sequence("tiny")
    for module in (specs, methods):
        monkeypatch.setattr(module, "method_named", lambda name: Untrained())
    changes = {"methods": {"m": {"method": "nearest-frame", "set": {"init.budget": 200}}}}
    changes |= {"sequences": {"tiny": {"path": "tiny", "first_frames": 9}}, "seeds": [3], "budgets": [150]}
    spec, jobs = load_spec(write_spec(tmp_path, **changes)), []
    run_matrix(spec, tmp_path / "out", lambda found: iter(jobs.extend(found) or []))
    (job,) = jobs
    assert job.options["init"]["budget"] == 150 and job.options["seed"] == 3
    assert job.options["schedule"]["fine_iterations"] == 5 and job.reading["first_frames"] == 9
    work(job)
    stored = json.loads((Path(job.folder) / "metrics.json").read_text())
    assert stored["scores"]["num_gaussians"] > 50 and "fps" in stored["scores"]
    assert stored["plugin"]["options"] == to_dict(job.options)
    assert (Path(job.folder) / "run" / "scene.safetensors").exists()


def test_cells_of_images_without_a_seed_are_one_for_each_sequence(tmp_path):
    spec = load_spec(write_spec(tmp_path, methods={"theirs": {"pictures": {"ph": "a/{seed}", "other": "b"}}}))
    assert [(cell.sequence, cell.seed) for cell in cells(spec)] == [("ph", 0), ("other", 0), ("ph", 1)]
    folders = [spec.config("theirs", "ph", None, seed).folder for seed in (0, 1)]
    assert folders == [str(tmp_path / "a" / "0"), str(tmp_path / "a" / "1")]
    assert spec.config("theirs", "ph", None, 0).name == "theirs"


@pytest.mark.parametrize(
    ("method", "said"),
    [
        ({"method": "nearest-fram"}, "methods.m.method: expected one of default, .*nearest-frame, got 'nearest"),
        ({"method": "pictures"}, "methods.m.method: expected one of"),
        ({"preset": "nearest-frame"}, "methods.m.preset: expected one of default, .*deform3dgs.*, got"),
        ({"method": "nearest-frame", "preset": "paper"}, "methods.m: expected one of preset, method and pictures"),
        ({"method": "nearest-frame", "set": {"frames": 3}}, "methods.m.set: expected the name"),
        ({"method": "nearest-frame", "set": {"num_frames": "x"}}, "methods.m.num_frames: expected an integer"),
        ({"method": "nearest-frame", "set": {"num_frames": 0}}, "num_frames must be in"),
        ({"pictures": {"typo": "x"}}, "methods.m.pictures: expected one of ph, other, got 'typo'"),
        ({"pictures": {"ph": ""}}, r"methods.m.pictures.ph: expected a folder, got nothing"),
        ({"depth_pictures": {"ph": "x"}}, "methods.m: expected depth_pictures and depth_scale beside pictures"),
    ],
)
def test_mistakes_are_named(tmp_path, method, said):
    with pytest.raises(InputError, match=said):
        load_spec(write_spec(tmp_path, methods={"m": method}))
