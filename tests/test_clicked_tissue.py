"""One click on masked tissue frees it in all frames: on a moving scene, beside a tool, and wrong clicks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.data.images import read_tool_mask
from endoprior.tool_masks.clicked_tools import ToolClick, free_clicked

HEIGHT, WIDTH, FRAMES = 96, 128, 7


def ligament(frame):
    """(H, W) True on a band of tissue that moves with the image, and that every mask takes for a tool."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[30:45, 20 + 3 * frame : 70 + 3 * frame] = True
    return mask


def shaft(frame):
    """(H, W) True on a tool; in frame 4 it touches the band."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[45 if frame == 4 else 60 :, 60:110] = True
    return mask


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(5)
    wide = cv2.GaussianBlur(rng.normal(120, 300, (HEIGHT, WIDTH + 40, 3)).astype(np.float32), (0, 0), 3)
    for part in ("images", "masks"):
        (tmp_path / "DATA" / part).mkdir(parents=True)
    for i in range(FRAMES):
        image = np.clip(wide[:, 30 - 3 * i : 30 - 3 * i + WIDTH], 0, 255)
        image[shaft(i)] = 200
        cv2.imwrite(str(tmp_path / "DATA" / "images" / f"{i}.png"), image.astype(np.uint8))
        mask = np.where(ligament(i) | shaft(i), 255, 0).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "DATA" / "masks" / f"{i}.png"), mask)
    return tmp_path / "DATA"


def test_the_region_is_freed_in_all_frames_and_the_tool_stays(folder):
    sequence = load_sequence(folder)
    steps = list(free_clicked(sequence, [ToolClick(2, 40, 36)], lambda i: ~sequence.frame(i).tissue_mask))
    assert [step.done for step in steps] == list(range(1, FRAMES + 1))
    freed = {step.frame: step.region for step in steps}
    assert sorted(freed) == list(range(FRAMES))
    for i, region in freed.items():
        both = region & ligament(i)
        assert both.sum() > (0.75 if i == 4 else 0.95) * ligament(i).sum(), i
        assert (region & shaft(i)).sum() < 0.05 * shaft(i).sum(), i


def test_a_region_that_leaves_the_image_is_not_followed_into_another(folder):
    for i in range(3, FRAMES):
        cv2.imwrite(str(folder / "masks" / f"{i}.png"), np.where(shaft(i), 255, 0).astype(np.uint8))
    sequence = load_sequence(folder)
    steps = list(free_clicked(sequence, [ToolClick(2, 40, 36)], lambda i: ~sequence.frame(i).tissue_mask))
    assert not any(step.region.any() for step in steps if step.frame >= 3)


@pytest.mark.parametrize(
    ("click", "words"),
    [
        (ToolClick(2, 5, 5), "tissue that is masked"),
        (ToolClick(9, 5, 5), "a frame of 0..6"),
        (ToolClick(0, 500, 5), "a place in 128x96 px"),
    ],
)
def test_a_wrong_click_is_one_line_before_anything_is_done(folder, click, words):
    sequence = load_sequence(folder)
    with pytest.raises(InputError, match=words):
        free_clicked(sequence, [click], lambda i: ~sequence.frame(i).tissue_mask)


def test_the_command_removes_pixels_only_and_keeps_the_masks_before(folder, capsys):
    assert main(["masks", str(folder), "--tissue", "2,40,36"]) == 0
    assert f"freed in {FRAMES} of {FRAMES} frames" in capsys.readouterr().out
    for i in range(FRAMES):
        now, before = (read_tool_mask(folder / part / f"{i}.png") for part in ("masks", "masks_before"))
        assert not (now & ~before).any() and (now & shaft(i)).sum() > 0.95 * shaft(i).sum()
        assert (now & ligament(i)).sum() < 0.3 * ligament(i).sum()


@pytest.mark.parametrize("other", [["--refine"], ["--tool", "2,5,5"], ["--with", "sam2"]])
def test_one_kind_of_search_at_a_time(folder, other, capsys):
    assert main(["masks", str(folder), "--tissue", "2,40,36", *other]) == 2
    said = capsys.readouterr().err
    assert "expected no" in said and "\n" not in said.strip()
