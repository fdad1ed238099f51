"""Scores of tool masks: closed forms, a slow loop, identities, the pixels that count, true mask files, the command."""

from __future__ import annotations

import json
import math
import shutil
from collections import Counter

import cv2
import numpy as np
import pytest
from frame_strategies import SIDES, masks
from hypothesis import given
from hypothesis import strategies as st
from hypothesis_profiles import examples

from endoprior import load_sequence
from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data.frame_files import BY_NAME, BY_NUMBER
from endoprior.evaluation.true_masks import (
    NO_VALUE,
    SCORES,
    TOLERANCE,
    TrueMasks,
    count,
    counted_pixels,
    score_masks,
    scores_of,
    tips,
)
from endoprior.footage.round_border import Circle

SHAPE = (240, 320)  # a diagonal of 400 px: outlines agree within exactly 3 px
ALL = np.ones(SHAPE, bool)


def box(top, left, bottom, right, shape=SHAPE):
    mask = np.zeros(shape, bool)
    mask[top:bottom, left:right] = True
    return mask


def scores(found, truth, counted=None):
    return scores_of(count(found, truth, ALL if counted is None else counted))


def test_a_square_moved_by_a_quarter_of_its_side():
    truth = box(100, 100, 140, 140)
    found = scores(box(100, 110, 140, 150), truth)
    assert found["mask_iou"] == pytest.approx(30 / 50)
    assert found["missed_area"] == found["false_area"] == pytest.approx(10 / 40)
    assert math.isnan(found["false_share_of_view"]) and math.isnan(found["missed_tips"])
    # Of the top and bottom rows 30 + 3 of 40 px agree, of the left and right columns 3 px at each end.
    assert found["boundary_f1"] == pytest.approx((2 * 33 + 2 * 3) / (4 * 39))


@pytest.mark.parametrize(("moved", "agreed"), [(3, True), (4, False)])
def test_outlines_agree_up_to_the_tolerance(moved, agreed):
    truth, found = box(0, 0, 240, 100), box(0, 0, 240, 100 + moved)  # one outline each: image edges are none
    assert scores(found, truth)["boundary_f1"] == agreed


def test_frames_without_a_tool():
    none, wrong = np.zeros(SHAPE, bool), box(0, 0, 24, 32)
    assert scores(none, none) == pytest.approx(
        dict.fromkeys(NO_VALUE, math.nan) | {"false_share_of_view": 0.0}, nan_ok=True
    )
    found = scores(wrong, none)
    assert found["mask_iou"] == found["boundary_f1"] == 0 and found["false_share_of_view"] == pytest.approx(0.01)
    assert math.isnan(found["false_area"]) and math.isnan(found["missed_area"])


def test_the_score_of_a_sequence_pools_pixels():
    small, large = box(0, 0, 10, 10), box(0, 0, 30, 30)
    none = np.zeros(SHAPE, bool)
    total = count(none, small, ALL) + count(large, large, ALL) + count(small, none, ALL)
    pooled = scores_of(total)
    assert pooled["missed_area"] == pytest.approx(100 / 1000) and pooled["false_area"] == 0
    assert pooled["mask_iou"] == pytest.approx(900 / 1100)
    assert pooled["false_share_of_view"] == pytest.approx(100 / ALL.size)


def test_pixels_that_do_not_count_have_no_influence():
    truth, counted = box(50, 0, 90, 200), ~box(0, 0, 240, 40)
    assert count(truth | ~counted, truth & counted, counted) == count(truth, truth, counted)
    assert scores(truth, truth, counted)["missed_tips"] == 0  # the tool enters at the border, not at the image edge


def blobs(seed):
    """Two smooth random masks that resemble each other."""
    rng = np.random.default_rng(seed)
    first, second = (cv2.GaussianBlur(rng.normal(size=SHAPE), (0, 0), 12) for _ in range(2))
    return first > 0.03, first + 0.3 * second > 0.03


@pytest.mark.parametrize("seed", range(3))
def test_boundary_f1_is_that_of_a_slow_loop(seed):
    found, truth = blobs(seed)
    counted = Circle(160, 120, 140).mask(320, 240)

    def outline(mask):
        places = []
        for y, x in np.argwhere(mask & counted).tolist():
            for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                if 0 <= v < 240 and 0 <= u < 320 and counted[v, u] and not mask[v, u]:
                    places.append((y, x))
                    break
        return places

    def share(some, others):
        limit = (TOLERANCE * math.hypot(240, 320)) ** 2 + 1e-9
        return np.mean([any((y - v) ** 2 + (x - u) ** 2 <= limit for v, u in others) for y, x in some])

    one, other = outline(found), outline(truth)
    precision, recall = share(one, other), share(other, one)
    expected = 2 * precision * recall / (precision + recall)
    assert 0.1 < expected < 0.99
    assert scores(found, truth, counted)["boundary_f1"] == pytest.approx(expected)


def test_the_tip_is_the_last_tenth_of_the_way_into_the_image():
    bar = box(100, 0, 105, 100)
    np.testing.assert_array_equal(tips(bar, ALL), box(100, 90, 105, 100))
    bent = bar | box(5, 95, 105, 100)  # the way leads around the corner: its tip is at the top
    marked = tips(bent, ALL)
    assert marked.any() and np.argwhere(marked).max(0).tolist()[0] < 30
    assert scores(bar & ~box(0, 95, 240, 320), bar)["missed_tips"] == pytest.approx(0.5)
    assert scores(bar & ~box(0, 0, 240, 50), bar)["missed_tips"] == 0  # the shaft is no tip


def test_a_diagonal_step_is_longer_than_a_straight_one():
    arm, diagonal = box(100, 0, 101, 121), np.zeros(SHAPE, bool)
    diagonal[100 + np.arange(86), 20 + np.arange(86)] = (
        True  # 20 + 85 * 1.41 = 140 px from the edge; the arm ends at 120
    )
    marked = tips(arm | diagonal, ALL)
    assert marked.any() and not (marked & ~diagonal).any()


def test_every_tool_has_a_tip_of_its_own_if_it_enters_the_image():
    short, long, island = box(10, 0, 14, 20), box(220, 100, 240, 105), box(100, 100, 140, 140)
    marked = tips(short | long | island, ALL)
    assert (marked & short).any() and (marked & long).any() and not (marked & island).any()
    assert not tips(box(0, 0, 1, 320), ALL).any()  # as thin as the edge itself
    view = Circle(160, 120, 100).mask(320, 240)
    from_border = tips(box(118, 0, 122, 160), view)
    assert np.argwhere(from_border).min(0)[1] > 140  # from the round border, at x = 60, to x = 160
    label = ~box(115, 100, 125, 120)  # a hole in the view is no edge of it
    assert not tips(box(110, 90, 130, 130), label).any()


@examples(60)
@given(st.data())
def test_identities(data):
    shape = data.draw(st.tuples(SIDES, SIDES))
    found, truth, counted = (data.draw(masks(*shape)) for _ in range(3))
    forth, back = scores_of(count(found, truth, counted)), scores_of(count(truth, found, counted))
    for name in ("mask_iou", "boundary_f1"):
        assert forth[name] == pytest.approx(back[name], nan_ok=True)
    for name, value in forth.items():
        assert math.isnan(value) or value >= 0
        assert math.isnan(value) or value <= 1 or name == "false_area"
    for name, value in scores_of(count(truth, truth, counted)).items():
        assert math.isnan(value) or value == (name in ("mask_iou", "boundary_f1"))
    assert not (tips(truth, counted) & ~(truth & counted)).any()


def moving(count=8):
    """Images of blobs that slide, none of them black."""
    rng = np.random.default_rng(0)
    levels = np.clip(130 + 40 * cv2.GaussianBlur(rng.normal(size=(320, 420)), (0, 0), 4) * 14, 40, 255)
    parts = [levels[9 * k :][:240, 11 * k :][:, :320] for k in range(count)]
    return [(part[..., None] * [1.0, 0.6, 0.5]).astype(np.uint8) for part in parts]


def test_the_border_does_not_count_and_a_static_tool_does():
    view, tool = Circle(160, 120, 110).mask(320, 240), box(100, 0, 140, 150)
    dark = box(100, 0, 140, 120)
    rng = np.random.default_rng(1)
    images = []
    for image in moving():
        image[tool] = 140  # gray, in the same place in all images
        image[dark] = rng.integers(1, 12, (int(dark.sum()), 1))  # a shaft as dark as the border
        image[~view] = rng.integers(0, 12, (int((~view).sum()), 1))
        images.append(image)
    counted = counted_pixels(images, tool | ~view)
    inside = Circle(160, 120, 110).mask(320, 240, 6)  # the detected circle is exact to 2 px; 3 px are the margin
    assert counted[inside].all() and not counted[~view].any()
    assert counted_pixels(images, tool)[~view & ~box(95, 0, 145, 320)].all()  # masked by neither: it counts


def test_labels_do_not_count():
    painted, panel, tool = box(0, 0, 30, 60), box(200, 200, 230, 300), box(100, 0, 140, 150)
    larger = box(0, 0, 40, 90)  # the panel of which the masks of a painter know more than `prepare` painted
    images = []
    for image in moving():
        image[painted], image[tool], image[panel] = 0, 140, (30, 110, 60)
        cv2.putText(image, "ROOM12", (204, 223), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 2)
        images.append(image)
    counted = counted_pixels(images, painted | panel | tool)
    assert not counted[painted | panel].any() and counted[tool].all()
    around = ~cv2.dilate((painted | panel).astype(np.uint8), np.ones((9, 9))).astype(bool)
    assert counted[around].all()
    counted = counted_pixels(images, larger | tool)
    assert not counted[larger].any() and counted[tool].all()
    # A tool below the text stays, but for the text.
    below = counted_pixels(images, painted | panel | box(200, 0, 230, 300))
    assert below[:, :180][210].sum() > 150


@pytest.fixture
def sequence(tiny_sequence):
    return load_sequence(tiny_sequence)


def true_masks(sequence, indices, folder, suffix=".png", name="{:06d}", inverted=False):
    """The sequence's own masks as files."""
    folder.mkdir()
    for i in indices:
        tool = ~sequence.frame(i).tissue_mask ^ inverted
        path = folder / (name.format(i) + suffix)
        if suffix == ".npy":
            np.save(path, tool)
        else:
            cv2.imwrite(str(path), 255 * tool.astype(np.uint8))
    return folder


@pytest.mark.parametrize(
    ("indices", "options", "rule"),
    [
        (range(17), {}, BY_NAME),
        ([2, 9, 11], {}, BY_NAME),
        ([2, 9, 11], {"name": "label_{}", "suffix": ".npy"}, BY_NUMBER),
        (range(17), {"name": "a{}b3"}, BY_NUMBER),
        ([2, 9], {"inverted": True}, BY_NAME),
    ],
)
def test_mask_files_are_matched_and_read(tmp_path, sequence, indices, options, rule):
    truth = TrueMasks(true_masks(sequence, indices, tmp_path / "t", **options), sequence)
    assert (truth.indices, truth.matched_by) == (list(indices), rule)
    for i in indices:
        np.testing.assert_array_equal(truth.tool(i), ~sequence.frame(i).tissue_mask)
    result = score_masks(sequence, truth)
    assert result.scores["mask_iou"] == result.scores["boundary_f1"] == 1
    assert result.scores["missed_area"] == result.scores["false_area"] == result.scores["missed_tips"] == 0
    assert result.skipped == {"false_share_of_view": NO_VALUE["false_share_of_view"]}
    assert [row["index"] for row in result.per_frame] == result.protocol["frames"] == list(indices)


def test_a_sequence_folder_says_which_value_marks_tools(tmp_path, sequence):
    other = tmp_path / "other"
    shutil.copytree(sequence.path, other)
    described = json.loads((other / "sequence.json").read_text())
    (other / "sequence.json").write_text(json.dumps(described | {"mask_tool_value": 0}))
    truth = TrueMasks(other, sequence)
    np.testing.assert_array_equal(truth.tool(3), sequence.frame(3).tissue_mask)
    assert truth.polarity.startswith("low values") and truth.folder == other / "masks"
    np.testing.assert_array_equal(TrueMasks(sequence.path, sequence).tool(3), ~sequence.frame(3).tissue_mask)


def test_equal_names_of_other_frames_are_an_error(tmp_path, sequence):
    """A folder of the same video that begins at its middle."""
    other = tmp_path / "other"
    for name in ("images", "masks"):
        (other / name).mkdir(parents=True)
        for i in range(8):
            shutil.copy(sequence.path / name / f"{i + 8:06d}.png", other / name / f"{i:06d}.png")
    with pytest.raises(
        InputError, match=r"other/images: expected the frames of .*, got 00000\d.png, which is more like"
    ):
        TrueMasks(other, sequence)
    shutil.rmtree(other / "images")
    assert TrueMasks(other, sequence).indices == list(range(8))


def test_the_command_prints_and_writes_where_it_is_told(tmp_path, sequence, capsys):
    truth = true_masks(sequence, [2, 9], tmp_path / "t")
    mask = cv2.imread(str(truth / "000009.png"), 0)
    cv2.imwrite(str(truth / "000009.png"), np.zeros_like(mask))
    before = sorted(tmp_path.rglob("*"))
    words = ["eval", "--masks", str(truth), str(sequence.path)]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert f"{truth}: true masks of 2 of 17 frames, {BY_NAME}" in out
    assert "masks   IoU " in out and "missed tips" in out and "to keep the scores: --out FOLDER" in out
    assert sorted(tmp_path.rglob("*")) == before
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    stored = json.loads((tmp_path / "out/mask_scores.json").read_text())
    share = (mask > 0).mean()
    assert stored["scores"]["false_share_of_view"] == pytest.approx(share) and stored["skipped"] == {}
    assert stored["protocol"]["frames_with_a_tool"] == 1
    assert stored["protocol"]["data_fingerprint"] == sequence.fingerprint()
    rows = json.loads((tmp_path / "out/mask_scores_per_frame.json").read_text())
    assert [row["index"] for row in rows] == [2, 9] and rows[0]["mask_iou"] == 1
    assert rows[1].keys() == {"index", "time", "mask_iou", "boundary_f1", "false_share_of_view"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--masks", "absent"], "absent: expected a folder of true masks, got nothing"),
        (["--masks", "empty"], "empty: expected mask files (.png, "),
        (["--masks", "many"], "many: expected files of the 17 frames, got 1 of 2 files of no frame, such as 99.png"),
        (["--masks", "small/images"], "small/images/000000.png: expected 48x40 px like the images, got 24x20"),
        (["--masks", "few", "--no-networks"], "--no-networks: expected --masks TRUTH DATA, with no option but --out"),
        (["--masks", "few", "--pictures", "few"], "--pictures: expected --masks TRUTH DATA"),
        (["--masks", "few", "--out", "few/000002.png"], "--out few/000002.png: expected the path of a folder"),
    ],
)
def test_wrong_input_is_one_line(tmp_path, sequence, capsys, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "small").mkdir()
    true_masks(sequence, [2, 9], tmp_path / "few")
    for folder, name, shape in (
        ("many", "3", (40, 48)),
        ("many", "99", (40, 48)),
        ("small/images", "000000", (20, 24)),
    ):
        (tmp_path / folder).mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / folder / f"{name}.png"), np.zeros(shape, np.uint8))
    assert main(["eval", *words, str(sequence.path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"endoprior: {said}")


def test_a_photo_is_no_mask(sequence):
    with pytest.raises(InputError, match="expected a mask, got an image of many colors"):
        TrueMasks(sequence.path / "images", sequence)


def test_every_score_says_why_it_may_have_no_value():
    assert [score.name for score in SCORES] == list(NO_VALUE) == list(scores_of(Counter()))


def test_real_clip(real_clip):
    """Masks 2 px too wide on a real clip, whose burned-in label is masked, too."""
    sequence = load_sequence(real_clip)
    images = [sequence.frame(i).rgb_u8 for i in range(0, 90, 11)]
    masked = [~sequence.frame(i).tissue_mask for i in range(0, 90, 11)]
    counted = counted_pixels(images, np.logical_and.reduce(masked))
    assert not counted[:40, :100].any() and counted[50:].all()
    wide = cv2.dilate(masked[0].astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
    found = scores_of(count(wide, masked[0], counted))
    assert found["missed_area"] == found["missed_tips"] == 0 and 0.05 < found["false_area"] < 0.15
    assert 0.85 < found["mask_iou"] < 0.95 and found["boundary_f1"] > 0.99
