"""The protocols of other papers: closed forms, slow loops, masks that are missing, the command line."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.data.images import save_png
from endoprior.evaluation.networks import WeightsMissing
from endoprior.evaluation.pictures import Pictures
from endoprior.evaluation.protocols.compute import NETWORKS, rows_of
from endoprior.evaluation.protocols.table import KEYS, OURS, PROTOCOLS, SCORES, Protocol, chosen_protocols
from endoprior.evaluation.scorers.image import ssim, ssim_valid
from endoprior.evaluation.scorers.lpips import LpipsDistance
from endoprior.evaluation.scoring import evaluate

TAGS = Path(__file__).parents[1] / "src" / "endoprior_studies" / "published_tags.csv"
TEST = [1, 9]
NAMES = PROTOCOLS.names()
ZEROS = np.zeros((40, 48), bool)


@pytest.mark.parametrize(
    ("protocol", "height", "shrink", "rows"),
    [
        (Protocol("", "", "masks", kept_rows=500), 512, 1, (500, 0)),
        (Protocol("", "", "masks", kept_rows=500), 256, 2, (250, 0)),
        (Protocol("", "", "masks", kept_rows=500), 480, 1, (480, 0)),
        (Protocol("", "", "masks", masked_rows=12), 512, 1, (512, 12)),
        (Protocol("", "", "masks", masked_rows=12), 64, 8, (64, 2)),
        (Protocol("", "", "masks", masked_rows=12), 8, 1, (8, 8)),
        (OURS, 512, 1, (512, 0)),
    ],
)
def test_rows_follow_the_size_of_the_frame(protocol, height, shrink, rows):
    assert rows_of(protocol, height, shrink) == rows


def test_names_of_protocols():
    assert chosen_protocols("endogs, endonerf,endogs") == ("endogs", "endonerf")
    assert chosen_protocols("all") == chosen_protocols("endonerf,all") == NAMES
    for text in ("endonurf", "endonerf,", "ENDONERF"):
        with pytest.raises(InputError, match=r"--protocol: expected deform3dgs, .* or all, got "):
            chosen_protocols(text)


def test_what_the_paper_did_is_told_in_words_of_tags():
    assert all(set(dict(about.paper)) <= set(KEYS) for about in map(PROTOCOLS.load, NAMES))
    assert all("split" in dict(about.paper) for about in map(PROTOCOLS.load, NAMES))


@pytest.mark.parametrize("about", [*map(PROTOCOLS.load, NAMES), OURS], ids=lambda about: about.title)
def test_the_published_figures_have_the_tags_of_the_table(about):
    paper = {"split": "test", "saw_test_frames": "no", "background": "black"} | dict(about.paper)
    rows = f"0..{about.kept_rows - 1}" if about.kept_rows else "all"
    tags = [
        paper["split"],
        paper["saw_test_frames"],
        about.masks,
        f"last {about.masked_rows} masked" if about.masked_rows else rows,
        paper["background"],
        ("all pixels, " if about.over_frame else "tissue pixels, ")
        + ("all frames together" if about.pooled else "mean of frames"),
        "complete windows" if about.ssim_valid else "zeros around",
        f"{NETWORKS[about.lpips]}, [{about.lpips_lowest}, 1]",
        about.depth or "-",
    ]
    with TAGS.open(encoding="utf-8", newline="") as file:
        assert [about.title, *tags] in [[row[0], *row[2:]] for row in csv.reader(file)]


@pytest.fixture
def sequence(tiny_sequence):
    """The tiny sequence with `gt_masks/`: the same bar, but 4 columns narrower."""
    shutil.copytree(tiny_sequence / "masks", tiny_sequence / "gt_masks")
    for index, file in enumerate(sorted((tiny_sequence / "gt_masks").glob("*.png"))):
        tool = ~load_sequence(tiny_sequence).frame(index).tissue_mask
        narrow = tool & np.roll(tool, 4, axis=1)
        save_png(file, np.where(narrow, np.uint8(255), np.uint8(0)))
    return load_sequence(tiny_sequence)


def noisy(folder, sequence, indices=TEST):
    """Pictures of the frames, changed by noise of up to 20 gray levels; true depth plus 2 mm, of frame 9 plus 4."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for i in indices:
        frame, rng = sequence.frame(i), np.random.default_rng(i)
        noise = rng.integers(-20, 21, frame.rgb_u8.shape)
        save_png(folder / "rgb" / f"{i:06d}.png", np.clip(frame.rgb_u8 + noise, 0, 255).astype(np.uint8))
        np.save(folder / "depth" / f"{i:06d}.npy", frame.depth + np.float32(4 if i == 9 else 2))
    return folder


@pytest.fixture
def scored(tmp_path, sequence):
    """The result of all protocols on such pictures, and the pictures."""
    folder = noisy(tmp_path / "theirs", sequence)
    pictures = Pictures(folder / "rgb", sequence, "test", depth_folder=folder / "depth")
    return evaluate(pictures, sequence, networks=False, protocols=NAMES), pictures


def frames_of(sequence, pictures, masks):
    """(rendered, true, mask, frame) of the test frames; `masks` is the name of a folder."""
    other = load_sequence(sequence.path, DataConfig(use_gt_masks=masks == "gt_masks"))
    for i in TEST:
        frame = other.frame(i)
        yield pictures.render(i)[0], frame.rgb, frame.tissue_mask, frame


def test_scores_of_each_protocol_by_hand(sequence, scored):
    result, pictures = scored
    found = {name: about["scores"] for name, about in result.protocols.items()}
    plain, tools = (list(frames_of(sequence, pictures, name)) for name in ("masks", "gt_masks"))
    assert sum(f[2].sum() for f in tools) > sum(f[2].sum() for f in plain)

    def mse(frames, over):
        total = sum(float(((a[m].astype(float) - b[m]) ** 2).sum()) for a, b, m, _ in frames)
        return total / sum(3 * (m.size if over == "frame" else m.sum()) for _, _, m, _ in frames)

    assert found["endonerf"]["psnr"] == pytest.approx(-10 * np.log10(mse(tools, "frame")), abs=1e-6)
    assert found["endogs"]["psnr"] == pytest.approx(-10 * np.log10(mse(tools, "tissue")), abs=1e-6)
    assert found["endosurf"]["psnr"] == pytest.approx(-10 * np.log10(mse(plain, "tissue")), abs=1e-6)
    each = np.mean([-10 * np.log10(mse([frame], "frame")) for frame in plain])
    for name in ("endo4dgs", "endogaussian", "deform3dgs"):
        assert found[name]["psnr"] == pytest.approx(each, abs=1e-6) == pytest.approx(result.scores["psnr"], abs=1e-6)
    cut = [(a, b, np.concatenate([m[:-12], ZEROS[:12]]), f) for a, b, m, f in tools]
    each = np.mean([-10 * np.log10(mse([frame], "frame")) for frame in cut])
    assert found["surgicalgaussian"]["psnr"] == pytest.approx(each, abs=1e-6)
    assert found["surgicalgaussian"]["ssim"] == pytest.approx(np.mean([ssim(*f[:3]) for f in cut]), abs=1e-9)
    valid = np.mean([ssim_valid(*f[:3]) for f in plain])
    assert found["endosurf"]["ssim"] == pytest.approx(valid, abs=1e-9)
    first, second = ((mask & frame.depth_valid).sum() for _, _, mask, frame in plain)
    pooled = np.sqrt((4 * first + 16 * second) / (first + second))
    assert found["endosurf"]["depth_rmse_mm"] == pytest.approx(pooled, abs=1e-4) != pytest.approx(3, abs=0.1)
    assert result.scores["depth_rmse_mm"] == pytest.approx(3, abs=1e-4), "ours is the mean of frames"
    for name in ("endogaussian", "deform3dgs"):
        assert set(found[name]) == {"psnr", "ssim", "depth_rmse_8bit"}
    assert all("lpips" in about["skipped"] for about in result.protocols.values())


def test_8_bit_depth_counts_missing_depth_as_near(sequence, scored):
    result, pictures = scored
    wrapped = {"endogaussian": [], "deform3dgs": []}
    for i, (_, _, mask, frame) in zip(TEST, frames_of(sequence, pictures, "masks"), strict=True):
        near, total = frame.depth[frame.depth_valid].min(), 0
        rendered = pictures.render(i)[1]
        for y, x in np.argwhere(mask):
            true = int(frame.depth[y, x] if frame.depth_valid[y, x] else near)
            step = (int(rendered[y, x]) - true) % 256
            total += step * step % 256
        wrapped["endogaussian"].append(np.sqrt(total / mask.size))
        wrapped["deform3dgs"].append(np.sqrt(total / mask.sum()))
    for name, values in wrapped.items():
        score = result.protocols[name]["scores"]["depth_rmse_8bit"]
        assert score == pytest.approx(np.mean(values), rel=1e-9), name


def test_tags_are_those_of_ours_line_by_line(scored):
    result, _ = scored
    ours = result.protocol["tags"]
    assert list(ours) == list(KEYS) and ours["mask_folder"] == "masks" and ours["saw_test_frames"] == "not known"
    for name, about in result.protocols.items():
        assert list(about["tags"]) == list(KEYS), name
        assert set(about["scores"]) | set(about["skipped"]) <= set(SCORES)
    tags = {name: about["tags"] for name, about in result.protocols.items()}
    assert tags["endonerf"]["mask_folder"] == "gt_masks" and tags["endonerf"]["lpips"] == "AlexNet, [0, 1]"
    assert tags["endosurf"]["lpips"] == "VGG16, [-1, 1]" and tags["endosurf"]["color"] == "not rounded"
    assert tags["endogs"]["rows"] == "all 40" and tags["surgicalgaussian"]["rows"] == "all 40, 12 masked"
    assert tags["deform3dgs"]["depth"] == "8-bit, tissue" and ours["depth"] == "mm, mean of frames"


def test_a_protocol_without_its_masks_has_no_column_but_a_reason(tmp_path, tiny_sequence, capsys):
    sequence = load_sequence(tiny_sequence)
    folder = noisy(tmp_path / "theirs", sequence)
    words = ["eval", "--pictures", str(folder / "rgb"), str(sequence.path), "--no-networks"]
    assert main([*words, "--protocol", "surgicalgaussian,endo4dgs"]) == 0
    out = capsys.readouterr().out
    assert next(line for line in out.splitlines() if line.startswith("protocol ")).split()[1:] == ["ours", "endo4dgs"]
    assert "  not computed: PSNR, SSIM, LPIPS (surgicalgaussian): needs tool masks in gt_masks/" in out
    assert "  not computed: LPIPS (endo4dgs): network scores were not asked for" in out
    assert main([*words, "--protocol", "surgicalgaussian"]) == 0
    assert not any(line.startswith("protocol ") for line in capsys.readouterr().out.splitlines())


def test_without_gt_masks_only_the_paper_that_needs_them_has_no_scores(tmp_path, tiny_sequence):
    sequence = load_sequence(tiny_sequence)
    folder = noisy(tmp_path / "theirs", sequence)
    found = evaluate(Pictures(folder / "rgb", sequence, "test"), sequence, networks=False, protocols=NAMES).protocols
    without = found.pop("surgicalgaussian")
    assert without["scores"] == {} and without["tags"] == {} and set(without["skipped"]) == {"psnr", "ssim", "lpips"}
    assert all("gt_masks/, and the sequence has no such folder" in reason for reason in without["skipped"].values())
    assert all(about["tags"]["mask_folder"] == "masks" and "psnr" in about["scores"] for about in found.values())
    assert "depth" in found["endosurf"]["skipped"]["depth_rmse_mm"], "no depth was rendered"


def test_masks_of_a_run_with_gt_masks_are_read_again(tmp_path, sequence):
    reading = DataConfig(use_gt_masks=True)
    own = load_sequence(sequence.path, reading)
    folder = noisy(tmp_path / "theirs", own)
    pictures = Pictures(folder / "rgb", own, "test")
    result = evaluate(pictures, own, networks=False, reading=reading, protocols=("endogs", "endogaussian"))
    folders = {name: about["tags"]["mask_folder"] for name, about in result.protocols.items()}
    assert folders == {"endogs": "gt_masks", "endogaussian": "masks"}
    assert result.protocol["tags"]["mask_folder"] == "gt_masks"
    shutil.rmtree(sequence.path / "masks")
    result = evaluate(pictures, own, networks=False, reading=reading, protocols=("endogaussian",))
    assert "masks/, and the sequence has no such folder" in result.protocols["endogaussian"]["skipped"]["psnr"]


def test_masks_that_cannot_be_read_cost_the_scores_not_the_evaluation(tmp_path, sequence):
    folder = noisy(tmp_path / "theirs", sequence)
    next((sequence.path / "gt_masks").glob("*.png")).unlink()
    pictures = Pictures(folder / "rgb", sequence, "test")
    result = evaluate(pictures, sequence, networks=False, protocols=("endonerf", "endo4dgs"))
    assert "needs other masks of 17 frames" in result.protocols["endonerf"]["skipped"]["psnr"]
    assert "psnr" in result.protocols["endo4dgs"]["scores"]


def test_frame_0_is_left_out_of_the_video_only_where_the_paper_does(tmp_path, sequence):
    folder = noisy(tmp_path / "theirs", sequence, range(17))
    pictures = Pictures(folder / "rgb", sequence, "video")
    result = evaluate(pictures, sequence, "video", networks=False, protocols=("endonerf", "endo4dgs"))
    assert result.protocols["endonerf"]["tags"]["split"] == "video, 16 without 0"
    assert result.protocols["endo4dgs"]["tags"]["split"] == "video, 17 frames"


def test_rows_below_500_do_not_count_where_the_paper_cuts_them(tmp_path, make_tiny_sequence):
    sequence = load_sequence(make_tiny_sequence("tall", num_frames=3, height=512))
    folder = noisy(tmp_path / "theirs", sequence, [1])
    before, after = [], []
    for found in (before, after):
        pictures = Pictures(folder / "rgb", sequence, "test")
        found += evaluate(pictures, sequence, networks=False, protocols=("endonerf", "endogs")).protocols.values()
        image = (pictures.render(1)[0] * 255).round().astype(np.uint8)
        image[500:] = 0
        save_png(folder / "rgb" / "000001.png", image)
    assert before[1]["scores"] == after[1]["scores"] and before[1]["tags"]["rows"] == "0..499 of 512"
    assert before[0]["scores"]["psnr"] > after[0]["scores"]["psnr"] + 1


def test_only_the_paper_without_8_bit_files_sees_less_than_a_gray_level(tmp_path, sequence):
    (tmp_path / "fine").mkdir()
    for i in TEST:
        image = np.clip(sequence.frame(i).rgb_u8.astype(np.float64) / 255 + 0.4 / 255, 0, 1)
        cv2.imwrite(str(tmp_path / "fine" / f"{i:06d}.png"), np.round(image[..., ::-1] * 65535).astype(np.uint16))
    result = evaluate(Pictures(tmp_path / "fine", sequence, "test"), sequence, networks=False, protocols=NAMES)
    assert result.protocols["endosurf"]["scores"]["psnr"] == pytest.approx(-20 * np.log10(0.4 / 255), abs=0.1)
    others = [about for name, about in result.protocols.items() if name != "endosurf"]
    assert all(about["skipped"]["psnr"].startswith("infinite") for about in others), "rounding makes them exact"


def test_each_classifier_is_loaded_once_and_sees_the_range_of_the_protocol(tmp_path, sequence, monkeypatch):
    asked = []

    def load(backbone, weights_dir, *, download):
        asked.append((backbone, download))
        if backbone == "vgg":
            raise WeightsMissing("no weights for VGG16")
        return LpipsDistance(lambda a, b: (a - b).abs().mean())

    folder = noisy(tmp_path / "theirs", sequence)
    monkeypatch.setattr("endoprior.evaluation.protocols.compute.lpips_distance", load)
    monkeypatch.setattr("endoprior.evaluation.scoring.scorers", dict)
    pictures = Pictures(folder / "rgb", sequence, "test")
    evaluate(pictures, sequence, protocols=NAMES)
    assert sorted(asked) == [("alex", False), ("vgg", False)]
    asked.clear()
    found = evaluate(pictures, sequence, protocols=NAMES, download=True).protocols
    assert sorted(asked) == [("alex", True), ("vgg", False)]
    assert (
        found["endosurf"]["skipped"]["lpips"] == "no weights for VGG16" and "lpips" not in found["endosurf"]["scores"]
    )
    halves = found["endo4dgs"]["scores"]["lpips"], found["endogaussian"]["scores"]["lpips"]
    assert halves[0] == pytest.approx(halves[1] / 2, rel=1e-5), "[0, 1] is half as wide as [-1, 1]"


def test_exact_pictures_have_no_psnr_and_frames_without_tissue_have_no_scores(tmp_path, sequence):
    (tmp_path / "same").mkdir()
    for i in TEST:
        save_png(tmp_path / "same" / f"{i}.png", sequence.frame(i).rgb_u8)
    pictures = Pictures(tmp_path / "same", sequence, "test")
    skipped = evaluate(pictures, sequence, networks=False, protocols=NAMES).protocols["endogs"]["skipped"]
    assert skipped["psnr"].startswith("infinite")
    for file in (sequence.path / "gt_masks").glob("*.png"):
        save_png(file, np.full((40, 48), 255, np.uint8))
    found = evaluate(pictures, sequence, networks=False, protocols=("endonerf",)).protocols["endonerf"]
    assert found["scores"] == {} and found["skipped"]["psnr"] == "no tissue in the frames"


def test_the_command_prints_a_column_for_each_protocol(tmp_path, sequence, capsys):
    folder = noisy(tmp_path / "theirs", sequence)
    words = ["eval", "--pictures", str(folder / "rgb"), str(sequence.path), "--no-networks", "--out", str(tmp_path)]
    assert main([*words, "--protocol", "endosurf,endonerf"]) == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    head = next(line for line in lines if line.startswith("protocol "))
    assert head.split() == ["protocol", "ours", "endonerf", "endosurf"]
    assert len(next(line for line in lines if line.startswith("PSNR, dB")).split()) == 2 + 3
    assert next(line for line in lines if line.startswith("mask folder")).split() == [
        "mask", "folder", "masks", "gt_masks", "masks",
    ]  # fmt: skip
    assert any(
        line.startswith("  as published: split: all frames but the first; seen in training: yes") for line in lines
    )
    assert all(len(line) <= 102 for line in lines[lines.index(head) :][:13])
    stored = json.loads((tmp_path / "metrics.json").read_text())
    assert list(stored["protocols"]) == ["endonerf", "endosurf"] and "psnr" in stored["protocols"]["endonerf"]["scores"]
    assert "endonerf" not in json.dumps(stored["scores"])
    assert main(words) == 0
    assert "protocols" not in json.loads((tmp_path / "metrics.json").read_text())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--pictures", "P", "DATA", "--protocol", "endonurf"], "--protocol: expected deform3dgs, endo4dgs,"),
        (["nowhere", "--protocol", "nerf"], "got 'nerf'. Fix: See docs/scores.md."),
        (["--masks", "P", "DATA", "--protocol", "endonerf"], "--masks TRUTH DATA, with no option but --out"),
    ],
)
def test_bad_input_is_one_line(words, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["eval", *words]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1 and said in text and list(tmp_path.iterdir()) == []
