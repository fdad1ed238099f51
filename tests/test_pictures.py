"""Images of other programs: which file is which frame, what is rejected, and that the scores are those of a scene."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

from endoprior import load_sequence
from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data.frame_files import BY_NAME, BY_NUMBER
from endoprior.data.images import save_png
from endoprior.evaluation.context import NO_DEPTH, NO_SCENE
from endoprior.evaluation.pictures import Pictures
from endoprior.evaluation.scoring import evaluate

TOTAL, TEST = 17, [1, 9]


@pytest.fixture
def sequence(tiny_sequence):
    return load_sequence(tiny_sequence)


def write_frames(folder, sequence, indices, scale=1, change=0):
    """The frames of a sequence as PNG files of 8 or 16 bits (`scale` 257), some levels brighter."""
    folder.mkdir()
    for i in indices:
        rgb = np.clip(sequence.frame(i).rgb_u8.astype(int) + change, 0, 255) * scale
        pixels = rgb[..., ::-1].astype(np.uint16 if scale > 1 else np.uint8)
        cv2.imwrite(str(folder / f"{i:06d}.png"), pixels)
    return folder


@pytest.mark.parametrize(("scale", "bits"), [(1, 8), (257, 16)])
def test_frames_are_read_exactly(tmp_path, sequence, scale, bits):
    pictures = Pictures(write_frames(tmp_path / "p", sequence, TEST, scale), sequence, "test")
    color, depth = pictures.render(9)
    np.testing.assert_allclose(color, sequence.frame(9).rgb, atol=1e-7)
    assert color.dtype == np.float32 and depth is None
    facts = pictures.provenance["pictures"]
    assert (facts["bits"], facts["files"], facts["name"], facts["matched_by"]) == (bits, 2, "p", BY_NAME)


def test_16_bits_are_not_rounded(tmp_path, sequence):
    folder = write_frames(tmp_path / "p", sequence, TEST, 257)
    cv2.imwrite(str(folder / "000009.png"), np.full((40, 48, 3), 1000, np.uint16))
    assert Pictures(folder, sequence, "test").render(9)[0].max() == np.float32(1000 / 65535)


def test_scores_of_images_and_reasons_for_the_rest(tmp_path, sequence):
    pictures = Pictures(write_frames(tmp_path / "p", sequence, TEST, change=5), sequence, "test")
    result = evaluate(pictures, sequence, networks=False)
    mse = np.mean([((f.rgb - g) ** 2)[f.tissue_mask].mean() for f, g in shifted(sequence)])
    assert result.scores["psnr_tissue"] == pytest.approx(-10 * np.log10(mse), abs=0.05)
    assert {"psnr", "ssim", "strict_psnr", "strict_ssim", "flow_error_dis"} <= result.scores.keys()
    assert result.skipped["num_gaussians"] == result.skipped["fps"] == NO_SCENE
    assert result.skipped["depth_rmse_mm"] == NO_DEPTH
    assert result.skipped["flow_error_dis_adjacent"] == "needs more frames: there is no image of frame 0"
    assert not result.scores.keys() & result.skipped.keys()
    assert not {"track_error_mm", "range_held_95", "ate_mm"} & result.skipped.keys()  # there is no ground truth
    assert [row["index"] for row in result.per_frame] == TEST and "psnr" in result.per_frame[0]
    assert "backend" not in result.protocol and result.protocol["frames"] == TEST


def shifted(sequence):
    for frame in sequence.frames("test"):
        yield frame, np.clip(frame.rgb_u8.astype(int) + 5, 0, 255).astype(np.float32) / 255


@pytest.mark.parametrize(("suffix", "scale"), [(".npy", None), (".png", 0.01)])
def test_depth_is_scored(tmp_path, sequence, suffix, scale):
    folder, depths = write_frames(tmp_path / "p", sequence, range(TOTAL)), tmp_path / "d"
    depths.mkdir()
    for i in range(TOTAL):
        depth = np.where(sequence.frame(i).depth > 0, sequence.frame(i).depth + 2, 0)
        if suffix == ".npy":
            np.save(depths / f"{i}.npy", depth)
        else:
            save_png(depths / f"{i}.png", np.rint(depth / scale).astype(np.uint16))
    pictures = Pictures(folder, sequence, "test", depth_folder=depths, depth_scale=scale)
    result = evaluate(pictures, sequence, networks=False)
    assert result.scores["depth_rmse_mm"] == pytest.approx(2, abs=0.01)
    assert "depth_instability_mm" in result.scores and "flow_error_dis_adjacent" in result.scores
    assert pictures.provenance["pictures"]["depth_matched_by"] == BY_NUMBER


@pytest.mark.parametrize(
    ("pixels", "said"),
    [
        (np.zeros((40, 50, 3), np.uint8), "expected 48x40 px like the frames of the sequence, got 50x40"),
        (np.zeros((40, 48), np.uint8), "expected an 8-bit or 16-bit RGB image, got 8-bit, 1 channel"),
        (np.zeros((40, 48, 4), np.uint8), "got 8-bit, 4 channels. Fix: Save it without alpha"),
    ],
)
def test_files_that_cannot_be_scored_are_named(tmp_path, sequence, pixels, said):
    folder = write_frames(tmp_path / "p", sequence, TEST)
    cv2.imwrite(str(folder / "000009.png"), pixels)
    with pytest.raises(InputError, match=said) as caught:
        Pictures(folder, sequence, "test").render(9)
    assert str(caught.value).startswith(str(folder / "000009.png"))


def test_depth_files_that_cannot_be_scored_are_named(tmp_path, sequence):
    folder, depths = write_frames(tmp_path / "p", sequence, TEST), tmp_path / "d"
    depths.mkdir()
    for i in TEST:
        save_png(depths / f"{i}.png", np.zeros((40, 48), np.uint8))
    with pytest.raises(InputError, match="expected mm per unit of PNG files, got none"):
        Pictures(folder, sequence, "test", depth_folder=depths)
    with pytest.raises(InputError, match="expected 16-bit depth, got 8-bit, 1 channel"):
        Pictures(folder, sequence, "test", depth_folder=depths, depth_scale=1.0).render(1)


def test_the_command_writes_scores_and_provenance(tmp_path, sequence, capsys):
    folder = write_frames(tmp_path / "p", sequence, TEST, change=5)
    words = ["eval", "--pictures", str(folder), str(sequence.path), "--no-networks"]
    assert main([*words, "--name", "Theirs", "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert f"2 of 17 frames, {BY_NAME}" in out and "tissue PSNR" not in out.split("\n")[0]
    stored = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert stored["pictures"]["name"] == "Theirs" and stored["scores"]["psnr"] > 20
    assert stored["protocol"]["data_fingerprint"] == sequence.fingerprint()
    assert len(json.loads((tmp_path / "out" / "per_frame.json").read_text())) == 2
    assert main(words) == 0 and (folder / "metrics.json").exists()  # beside the images by default


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--pictures", "absent"], "absent: expected a folder of rendered frames, got nothing"),
        (["--pictures", "empty"], "empty: expected PNG files, got none"),
        (["--pictures", "one"], "one: expected one file per frame, got 1 files for 2 frames, none numbered 9"),
        (["--pictures", "one", "--data", "x"], "--data: expected --pictures FOLDER DATA"),
        (["--pictures", "one", "--depth-scale", "nan"], "--depth-scale: expected a number above 0"),
        (["--name", "x"], "--name: expected --pictures beside it, got a run"),
    ],
)
def test_wrong_options_are_one_line(tmp_path, sequence, capsys, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    write_frames(tmp_path / "one", sequence, [1])
    assert main(["eval", str(sequence.path), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"endoprior: {said}")


class Odd:
    """A reconstruction that breaks its promise."""

    def __init__(self, color, depth=None):
        self.color, self.depth = color, depth

    def render(self, index):
        return self.color, self.depth


@pytest.mark.parametrize(
    ("color", "depth", "said"),
    [
        (np.zeros((40, 50, 3), np.float32), None, r"expected color of shape \(40, 48, 3\)"),
        (np.zeros((40, 48, 3)), None, "type float32, got .* and float64"),
        (np.full((40, 48, 3), 255, np.float32), None, r"expected color in \[0, 1\], got 255 to 255"),
        (np.full((40, 48, 3), np.nan, np.float32), None, "got nan to nan"),
        (np.zeros((40, 48, 3), np.float32), np.zeros((48, 40), np.float32), "expected depth of shape"),
    ],
)
def test_what_a_method_renders_is_checked(sequence, color, depth, said):
    with pytest.raises(InputError, match=rf"Odd.render\(1\): .*{said}"):
        evaluate(Odd(color, depth), sequence, networks=False)


@pytest.mark.parametrize(("option", "named"), [("folder", "rgb"), ("depth_folder", "depth")])
def test_a_folder_of_folders_names_the_one_to_pass(tiny_sequence, tmp_path, option, named):
    """What `endoprior render` writes, given as a whole."""
    sequence = load_sequence(tiny_sequence)
    for folder, suffix in (("depth", ".npy"), ("rgb", ".png"), ("side_by_side", ".png")):
        (tmp_path / folder).mkdir()
        for index in TEST:
            (tmp_path / folder / f"{index:06d}{suffix}").touch()
    save_png(tmp_path / "rgb/000001.png", sequence.frame(1).rgb_u8)
    folders = {"folder": tmp_path / "rgb"} | {option: tmp_path}
    with pytest.raises(InputError, match=f"got none. Fix: Pass {re.escape(str(tmp_path / named))}\\.$"):
        Pictures(sequence=sequence, split="test", **folders)
