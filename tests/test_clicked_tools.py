"""One click on a missed tool finds it in all frames: the fit, the region of a click, whole clips, and the command."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.data.found_tools import FrameRow, read_rows, write_rows
from endoprior.data.images import read_tool_mask
from endoprior.tool_masks.clicked_tools import ToolClick, find_clicked, parse_click
from endoprior.tool_masks.examples import (
    MAX_REGION,
    SURE,
    clicked_region,
    examples_of,
    feature_map,
    fit,
    fit_logistic,
    probability,
)

FRAMES, HEIGHT, WIDTH = 5, 96, 128
TISSUE, GREEN, BLUE = (150, 70, 60), (60, 110, 70), (40, 60, 150)


class Blind:
    """A finder that takes every pixel for tissue, as the network takes tools that it has never seen."""

    def log_odds(self, rgb_u8, view):
        scale = 192 / max(view.shape)
        return np.full([round(side * scale) for side in view.shape], -3, np.float32)


def bar(frame: int) -> np.ndarray:
    """The missed tool: a bar that enters from the left; the last frame does not show it."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[30 + 4 * frame : 44 + 4 * frame, : 60 + 3 * frame] = frame < FRAMES - 1
    return mask


def known(frame: int) -> np.ndarray:
    """The tool that is masked in every frame: a bar from below."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[60:, 100:112] = True
    return mask


@pytest.fixture
def folder(tmp_path):
    """A sequence of tissue, a masked blue bar, and a green one that the masks miss."""
    rng = np.random.default_rng(3)
    for part in ("images", "masks"):
        (tmp_path / "DATA" / part).mkdir(parents=True)
    for i in range(FRAMES):
        image = np.empty((HEIGHT, WIDTH, 3), np.float64)
        for where, color in ((slice(None), TISSUE), (bar(i), GREEN), (known(i), BLUE)):
            image[where] = color
        image += cv2.GaussianBlur(rng.normal(0, 20, (HEIGHT, WIDTH, 1)), (0, 0), 2)[..., None]
        cv2.imwrite(str(tmp_path / "DATA" / "images" / f"{i}.png"), image.clip(0, 255).astype(np.uint8)[..., ::-1])
        cv2.imwrite(str(tmp_path / "DATA" / "masks" / f"{i}.png"), np.where(known(i), 255, 0).astype(np.uint8))
    return tmp_path / "DATA"


def search(folder, *clicks, finder=None, tool=known):
    """What a search adds to each frame."""
    steps = list(find_clicked(load_sequence(folder), clicks, tool, finder or Blind()))
    assert [step.done for step in steps] == list(range(1, steps[0].total + 1))
    added = {step.frame: step.region for step in steps if step.region is not None}
    assert list(added) == list(range(FRAMES))
    return added


def overlap(a, b) -> float:
    return (a & b).sum() / max((a | b).sum(), 1)


def test_without_features_the_constant_gives_the_weighted_share():
    is_tool = np.array([True, True, False, False, False])
    weight = np.array([3.0, 1.0, 0.5, 0.25, 0.25])
    found = fit_logistic(np.zeros((5, 0)), is_tool, weight, np.zeros(5), 1.0)
    assert probability(found[0]) == pytest.approx(0.8, abs=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_the_fit_is_where_the_gradient_vanishes_and_beats_its_neighbors(seed):
    rng = np.random.default_rng(seed)
    x, weight = rng.normal(size=(300, 3)), rng.uniform(0.1, 2, 300)
    offset = rng.normal(size=300)
    is_tool = rng.random(300) < probability(offset + x @ (1, -2, 0.5) + 0.3)
    found = fit_logistic(x, is_tool, weight, offset, 1e-3)
    p = probability(offset + x @ found[:-1] + found[-1])
    assert np.abs(x.T @ (weight * (p - is_tool))).max() < 0.5
    assert abs(weight @ (p - is_tool)) < 0.5 and np.abs(found - (1, -2, 0.5, 0.3)).max() < 0.7


def test_examples_that_the_offset_is_sure_and_wrong_about_do_not_make_the_fit_diverge():
    x = np.concatenate([np.full((40, 1), 3.0), np.full((900, 1), -0.1)])
    is_tool = np.arange(940) < 40
    found = fit_logistic(x, is_tool, np.ones(940), np.full(940, -SURE), 1.0)
    p = probability(-SURE + x[:, 0] * found[0] + found[1])
    assert p[:40].min() > 0.8 and p[40:].max() < 0.1


def features_of(mask, seed=0):
    """Features of a frame whose tool has another color; the network sees nothing."""
    rng = np.random.default_rng(seed)
    image = rng.normal(0, 0.05, (6, *mask.shape)).astype(np.float32)
    image[1] += mask
    return feature_map(np.full(mask.shape, -9, np.float32), image)


def test_a_click_grows_to_the_region_of_its_look():
    tool = np.zeros((80, 120), bool)
    tool[20:40, 10:50] = True
    free = np.ones_like(tool)
    region = clicked_region(features_of(tool), free, (25, 30))
    assert overlap(region, tool) > 0.85
    free[:, 30:] = False
    half = clicked_region(features_of(tool), free, (15, 30))
    assert half[25:35, 12:28].mean() > 0.6 and not (half & ~free).any()
    with pytest.raises(ValueError, match="spot"):
        clicked_region(features_of(tool), free, (60, 30))


def test_a_click_on_tissue_stays_small():
    tool = np.zeros((80, 120), bool)
    region = clicked_region(features_of(tool), ~tool, (60, 40))
    assert region[40, 60] and region.sum() <= MAX_REGION * tool.size


def test_log_odds_count_only_up_to_a_limit():
    features = feature_map(np.array([[-30, 30, 1]], np.float32), np.zeros((6, 1, 3), np.float32))
    assert features[0, :, 0].tolist() == [-SURE, SURE, 1]


def test_the_same_tool_in_another_frame_is_no_example_of_tissue():
    one, other, none = np.zeros((3, 80, 120), bool)
    one[20:40, :50] = True
    other[50:70, :50] = True
    view = ~none
    clicked = examples_of(features_of(one), view, none, one)
    missed = [examples_of(features_of(other, seed), view, none, none) for seed in (1, 2)]  # said to be tissue here
    p = probability(fit([clicked, *missed]).log_odds(features_of(other, 9)))
    assert p[53:67, :47].mean() > 0.85 and p[:45].mean() < 0.05


def test_one_click_finds_the_tool_in_all_frames(folder):
    added = search(folder, ToolClick(1, 30.5, 41.5))
    for i, mask in added.items():
        assert mask.shape == (HEIGHT, WIDTH) and not (mask & known(i)).any()
        assert overlap(mask, bar(i)) > 0.8 if bar(i).any() else not mask.any(), i


def test_what_the_network_calls_tool_and_the_masks_call_tissue_stays_tissue(folder):
    """A person has removed it from the masks."""

    class Wrong(Blind):
        def log_odds(self, rgb_u8, view):
            log_odds = super().log_odds(rgb_u8, view)
            log_odds[:40, 150:] = 3
            return log_odds

    added = search(folder, ToolClick(1, 30.5, 41.5), finder=Wrong())
    assert overlap(added[2], bar(2)) > 0.7
    assert not any(mask[:24, 102:].any() for mask in added.values())


def test_two_clicks_teach_more_than_one(folder):
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    clicks = ToolClick(1, 30.5, 41.5), ToolClick(3, 106.0, 80.0)
    added = search(folder, *clicks, tool=lambda frame: nothing)
    assert all(overlap(added[i], bar(i) | known(i)) > 0.75 for i in range(FRAMES - 1))


@pytest.mark.parametrize(
    ("click", "said"),
    [
        (ToolClick(FRAMES, 5, 5), "a frame of 0..4"),
        (ToolClick(-1, 5, 5), "a frame of 0..4"),
        (ToolClick(0, WIDTH, 5), "a place in 128x96 px"),
        (ToolClick(0, float("nan"), 5), "a place in 128x96 px"),
        (ToolClick(0, 105, 80), "a masked pixel"),
    ],
)
def test_a_click_that_cannot_be_is_said_before_any_frame_is_searched(folder, click, said):
    with pytest.raises(InputError, match=said):
        find_clicked(load_sequence(folder), [click], known, Blind())


def masks_of(folder):
    return [read_tool_mask(folder / "masks" / f"{i}.png") for i in range(FRAMES)]


def test_the_command_adds_to_the_masks_and_keeps_the_originals(folder, capsys, monkeypatch):
    monkeypatch.setattr("endoprior.tool_masks.clicked_tools.ToolFinder", Blind)
    write_rows(folder, [FrameRow(i, 0.05, 0.4) for i in range(FRAMES)])
    assert main(["masks", str(folder), "--tool", "1,30.5,41.5"]) == 0
    said = capsys.readouterr().out
    assert f"added in {FRAMES - 1} of {FRAMES} frames" in said and "changed: frames 0-3\n" in said
    for i, mask in enumerate(masks_of(folder)):
        assert (mask >= known(i)).all() and (not bar(i).any() or overlap(mask & ~known(i), bar(i)) > 0.8)
        assert (folder / "masks_before" / f"{i}.png").exists() == bar(i).any()
    rows = read_rows(folder)
    assert rows[0].share > 0.1 and rows[-1].share == 0.05 and rows[0].confidence == 0.4
    assert (folder / "tool_masks.png").exists()


def test_a_folder_without_masks_gets_those_of_all_frames(folder, monkeypatch):
    monkeypatch.setattr("endoprior.tool_masks.clicked_tools.ToolFinder", Blind)
    for file in (folder / "masks").iterdir():
        file.unlink()
    (folder / "masks").rmdir()
    assert main(["masks", str(folder), "--tool", "1,30.5,41.5"]) == 0
    masks = masks_of(folder)
    assert all(overlap(masks[i], bar(i)) > 0.7 for i in range(FRAMES - 1)) and not masks[-1].any()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--tool", "1,30"], "--tool: expected FRAME,X,Y, got '1,30'. Fix: `--tool 12,310,205`."),
        (["--tool", "a,1,2"], "expected FRAME,X,Y"),
        (["--tool", "1,105,80"], "a masked pixel"),
        (["--tool", "1,30,41", "--refine"], "expected no --refine"),
    ],
)
def test_a_wrong_point_changes_nothing(folder, words, said, capsys):
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    assert main(["masks", str(folder), *words]) == 2
    assert said in capsys.readouterr().err
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before


def test_points_are_read_from_text():
    assert parse_click("3,1.5,20", "--tool") == ToolClick(3, 1.5, 20)
