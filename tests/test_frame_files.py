"""Which mask or depth file belongs to which frame; images and masks in one folder; the order of names."""

from __future__ import annotations

import random
from pathlib import Path

import cv2
import numpy as np
import pytest

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.data.files import bare, in_order, numbers_of, patterns_of
from endoprior.data.frame_files import BY_NAME, BY_NUMBER, match_files, match_names, one_per_frame
from endoprior.data.mask_folders import open_mask_folder

FOLDER = Path("m")


def named(numbers, form="m{:03d}.png"):
    return [form.format(number) for number in numbers]


def found(files, indices, images=()):
    """The name of the file of each frame."""
    matched = match_names(FOLDER, files, indices, images)
    assert list(matched.files) == list(indices)
    return [files[position] for position in matched.files.values()], matched.rule


@pytest.mark.parametrize(
    ("numbers", "indices", "want", "rule"),
    [
        (range(24), range(6, 9), [6, 7, 8], "counted from 0: m006.png for frame 6"),
        (range(1, 25), range(6, 9), [7, 8, 9], "counted from 1: m007.png for frame 6"),
        (range(3, 23), range(6, 9), [6, 7, 8], "counted from 0: m006.png for frame 6; if they are counted from 1"),
        (range(6, 9), range(6, 9), [6, 7, 8], "counted from 0"),
        (range(7, 10), range(6, 9), [7, 8, 9], "counted from 1"),
        (range(3), range(6, 9), [0, 1, 2], "in order, their numbers are counted otherwise: m000.png for frame 6"),
        (range(100, 103), range(6, 9), [100, 101, 102], "in order, their numbers are counted otherwise"),
        (range(12), range(0, 24, 2), list(range(12)), "in order, their numbers are counted otherwise"),
        (range(0, 24, 2), range(0, 24, 2), list(range(0, 24, 2)), "counted from 0"),
        ([0, 2, 3, 4], [0, 2], [0, 2], "counted from 0"),
    ],
)
def test_files_of_a_video_go_by_their_numbers(numbers, indices, want, rule):
    files, said = found(named(numbers), indices)
    assert files == named(want) and rule in said
    shuffled = named(numbers)
    random.Random(0).shuffle(shuffled)
    assert found(in_order(map(Path, shuffled)), indices)[0] == [Path(name) for name in named(want)]


def test_files_without_numbers_go_in_order():
    assert found(["a.png", "b.png", "c.png"], [4, 6, 9]) == (
        ["a.png", "b.png", "c.png"],
        "matched in order, each has no number of its own",
    )
    assert found(["a.png", "b.png", "c.png"], [1], ["x", "y", "z"])[0] == ["b.png"]


@pytest.mark.parametrize(
    ("images", "files", "indices", "want", "rule"),
    [
        ([10, 11, 13], range(30), [0, 1, 2], [10, 11, 13], "by name"),
        ([10, 11, 13], [10, 11, 13], [1, 2], [11, 13], "by name"),
        ([10, 11, 13], [10, 13], [0, 2], [10, 13], "by name"),
        (range(1, 9), range(8), [2, 3], [2, 3], "in order"),  # all are one apart
        (range(8), range(1, 9), [2, 3], [3, 4], "in order"),
        (range(1, 9), range(1, 20), [2, 3], [3, 4], "by name"),
        (range(0, 40, 5), range(8), [2, 3], [2, 3], "in order"),
        ([1000, 1041, 1083], range(3), [0, 2], [0, 2], "in order"),
    ],
)
def test_files_of_images_go_by_name_or_number(images, files, indices, want, rule):
    assert found(named(files), indices, [name[:-4] for name in named(images)])[0] == named(want)
    names = named(images, "frame_{:05d}_endo")
    other, said = found(named(files), indices, names)
    assert other == named(want) and rule.replace("by name", "by the numbers") in said


def test_a_name_may_say_mask_anywhere():
    images = ["liver", "colon", "cecum"]
    files = ["mask_cecum.png", "mask_colon.png", "mask_liver.png"]
    assert found(files, [0, 2], images) == (["mask_liver.png", "mask_cecum.png"], "matched by name")
    assert bare("frame_80_endo_color_mask") == bare("frame_80_endo_color") != bare("frame_81_endo_color")


@pytest.mark.parametrize(
    ("numbers", "indices", "images", "says"),
    [
        ([0, 1, 2, 4, 5], range(5), range(5), "5 files for 5 frames, none numbered 3"),
        ([0, 1, 2, 4, 5], range(5), (), "none numbered 3"),
        ([1, 2, 10], range(3), (), "none numbered 3"),
        (range(12), range(12), [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12], "none numbered 12"),
        (range(0, 24, 2), range(12), (), "none numbered 1, 3, 5, 7 and 2 more"),
        ([10, 11], [0, 1], [10, 40], "none numbered 40"),
        ([0, 1], range(3), (), "none numbered 2"),
        ([], range(3), (), "got none"),
    ],
)
def test_as_many_files_with_other_numbers_are_an_error(tmp_path, numbers, indices, images, says):
    for name in named(numbers):
        (tmp_path / name).touch()
    with pytest.raises(InputError) as error:
        match_files(tmp_path, (".png",), "masks", indices, named(images, "m{:03d}"))
    assert says in str(error.value) and "\n" not in str(error.value)


def test_names_that_tell_nothing_are_an_error():
    for files in (["m1.png", "n1.png"], ["x.png", "y.png"]):
        with pytest.raises(InputError, match=rf"2 files for 3 frames, such as {files[0]} and {files[1]}"):
            match_names(FOLDER, files, range(3))


OWN, FROM_ONE, TEST = [f"{i:06d}" for i in range(17)], [f"{i + 1:06d}" for i in range(17)], [1, 9]


@pytest.mark.parametrize(
    ("stems", "own", "rule", "frames"),
    [
        (["000001", "000009"], OWN, BY_NAME, [1, 9]),
        (["frame-b", "frame-j"], [f"frame-{c}" for c in "abcdefghijklmnopq"], BY_NAME, [1, 9]),
        (["00001", "00009"], OWN, BY_NUMBER, [1, 9]),
        (["r_1", "r_9", "r_10"], [], "counted from 0", [1, 9, 10]),
        (["000001", "000009"], FROM_ONE, "counted from 0", [1, 9]),  # by name, test frame 1 would be missing
        (["000002", "000010"], FROM_ONE, BY_NAME, [1, 9]),
        (["00000", "00001"], OWN, "in order", [1, 9]),
        (["first", "second"], [], "in order", [1, 9]),
        ([str(i + 1) for i in range(17)], OWN, "in order", list(range(17))),
        (FROM_ONE, FROM_ONE, BY_NAME, list(range(17))),
        (["1_2", "9_2", "3_2"], [], "counted from 0", [1, 3, 9]),
    ],
)
def test_frames_that_are_required_tell_the_rule(stems, own, rule, frames):
    matched = match_names(FOLDER, [f"{stem}.png" for stem in stems], range(17), own, required=TEST)
    assert rule in matched.rule and sorted(matched.files) == frames


@pytest.mark.parametrize(
    ("stems", "own", "said"),
    [
        (["000001", "000008"], OWN, "2 files for 2 frames, none numbered 9"),  # never zipped
        (["1", "9", "x"], OWN, "3 files for 2 frames, such as 1.png and x.png"),
        (["1", "01", "9"], [], "3 files for 2 frames"),  # one frame twice
        ([f"{i:06d}" for i in range(1, 11)], FROM_ONE, "10 names that are those of the images and also numbers of"),
    ],
)
def test_required_frames_without_a_file_are_an_error(stems, own, said):
    with pytest.raises(InputError, match=said):
        match_names(FOLDER, [f"{stem}.png" for stem in stems], range(17), own, required=TEST)


@pytest.mark.parametrize(
    ("images", "files", "want"),
    [
        (["0", "1", "2", "3"], ["0", "2", "3"], {0: 0, 2: 1, 3: 2}),
        (["0", "1", "3"], ["0", "2", "3"], {0: 0, 2: 2}),
        (["l1", "l2", "l3"], ["r2", "r3"], {1: 0, 2: 1}),
        (["a", "b", "c"], ["c_mask", "a_mask"], {0: 1, 2: 0}),
        (["5", "6"], ["1", "2", "3"], None),
        ([f"a{i}" for i in range(10)], [f"b{i}" for i in range(1, 11) if i != 5], None),  # one more, and one missing
        (["a", "b"], ["c", "d", "e"], None),
    ],
)
def test_frames_without_a_file_may_be_left_out(images, files, want):
    def match():
        return match_names(FOLDER, [f"{name}.png" for name in files], range(len(images)), images, required=())

    if want is not None:
        assert match().files == want
        return
    with pytest.raises(InputError):
        match()


@pytest.mark.parametrize("kind", ["endonerf", "plain", "hamlyn"])
def test_readers_keep_the_frames_that_have_all_files(tiny_sequence, kind):
    if kind == "hamlyn":
        (tiny_sequence / "sequence.json").unlink()
        (tiny_sequence / "depth").rename(tiny_sequence / "gt_depth")
    depth = "gt_depth" if kind == "hamlyn" else "depth"
    (tiny_sequence / "masks/000005.png").unlink()
    (tiny_sequence / depth / "000009.png").rename(tiny_sequence / depth / "000099.png")
    sequence = load_sequence(tiny_sequence, DataConfig(format=kind))
    assert sequence.image_names == [f"{i:06d}" for i in range(17) if i not in (5, 9)]
    remarks = [line.removeprefix(f"{tiny_sequence}/") for line in sequence.remarks]
    for part in ("masks", depth):
        assert f"{part}: 1 of 17 images have no file there and are left out" in remarks
    assert f"{depth}: 1 files of other frames are not used" in remarks
    assert sequence.frame(8).rgb_u8.shape == sequence.frame(0).rgb_u8.shape  # every file is read
    want = cv2.imread(str(tiny_sequence / "images/000010.png"))[..., ::-1]
    assert kind == "hamlyn" or (sequence.frame(8).rgb_u8 == want).all()


def test_times_in_seconds_are_sorted_as_numbers():
    times = [0.0, 0.04, 0.08, 0.12, 0.2, 0.36, 1.0, 1.04, 10.2]
    for form in ("{}.png", "t={}.png", "frame_{}_left.png"):
        names = [form.format(time) for time in times]
        assert [file.name for file in in_order(map(Path, sorted(names)))] == names
        assert numbers_of([Path(name).stem for name in names]) == times
    names = ["0.png", "0.04.png", "0.2.png", "1.png"]
    assert [file.name for file in in_order(map(Path, sorted(names)))] == names
    parts = ["1.8.png", "1.9.png", "1.10.png", "1.11.png", "2.1.png"]  # chapter and frame
    assert [file.name for file in in_order(map(Path, sorted(parts)))] == parts


def test_numbers_below_zero():
    assert numbers_of(["-2", "-1", "0", "1"]) == [-2, -1, 0, 1]
    assert numbers_of(["a_-0.5", "a_-0.25", "a_0.0", "a_0.5"]) == [-0.5, -0.25, 0, 0.5]
    assert numbers_of(["-002", "-001", "+000", "+001"]) == [-2, -1, 0, 1]
    assert numbers_of(["a+1", "a+2"]) == [1, 2]
    assert patterns_of(["t-002", "t-001", "t+000", "t+001"]) == ["t#"] * 4
    assert patterns_of(["a+1", "a+2"]) == ["a+#"] * 2
    assert numbers_of(["v2-1", "v2-2"]) == [1, 2]
    images, masks = ["-1", "0", "1"], ["-1_mask.png", "0_mask.png", "1_mask.png"]
    assert found(masks, range(3), images)[0] == masks


def test_the_number_is_the_one_that_differs():
    assert numbers_of(["v2_0007_640x512", "v2_0012_640x512"]) == [7, 12]
    assert numbers_of(["a1b1", "a2b1"]) == [1, 2]
    assert numbers_of(["a1", "b1"]) is None and numbers_of(["a1", "b"]) is None


ONE = [f"frame_{i}_endo" for i in range(80, 92)]
SERIES = {
    "masks": [f"{name}{role}.png" for name in ONE for role in ("", "_mask")],
    "many masks": [f"{name}{role}.png" for name in ONE for role in ("", "_mask", "_color_mask", "_watershed_mask")],
    "depth": [f"{name}{role}" for name in ONE for role in (".jpg", "_depth.png", "_normal.png")],
    "camel": [f"a_{i:06d}_{role}.png" for i in range(5) for role in ("leftImg8bit", "gtFine_labelIds")],
    "no numbers": [f"{name}{role}.png" for name in ("liver", "colon", "cecum") for role in ("", "-mask")],
}


@pytest.mark.parametrize("name", SERIES)
def test_masks_beside_images_are_no_images(name):
    files = in_order(map(Path, SERIES[name]))
    images, note = one_per_frame(FOLDER, files, "images")
    roles = ("mask", "depth", "normal", "label")
    assert [file.name for file in images] == [f.name for f in files if not any(role in f.name for role in roles)]
    assert note.startswith(f"m: {len(images)} of {len(files)} files are images; not ") and " (" in note


@pytest.mark.parametrize(
    "names",
    [
        [f"{i:06d}.{kind}" for i in range(5) for kind in ("png", "jpg")],
        [f"{side}_{i:06d}.png" for i in range(5) for side in ("left", "right")],
        [f"{name}.{kind}" for name in ("a", "b") for kind in ("png", "jpg")],
        [f"{role}{i}.png" for i in range(4) for role in ("mask", "depth")],
        [f"{i}{side}.png" for i in range(4) for side in "LR"],
        [f"{sign}{i:03d}.png" for i in range(1, 9) for sign in ("", "-")],
        [f"a{sign}{i}.png" for i in range(9) for sign in ("", "-")],
    ],
)
def test_two_series_are_named(names):
    with pytest.raises(InputError) as error:
        one_per_frame(FOLDER, in_order(map(Path, names)), "images")
    text = str(error.value)
    assert "m: expected one series of images, one file per frame, got " in text and "), " in text
    assert text.endswith("Fix: Put one of them into a folder of its own, and pass that.")


@pytest.mark.parametrize(
    "names",
    [
        [f"IMG_{i}.JPG" for i in range(4)] + [f"IMG_{i}.png" for i in range(4, 9)],
        ["a1.png", "b1.png", "c1.png"],
        [f"{i}{letter}.png" for i in range(12) for letter in "ab"],
        [f"frame_{i:03d}{letter}.JPG" for i in range(4) for letter in ("", "A", "B", "C")],
        [f"{i}.png" for i in range(-12, 12)],
        [f"t{i:+04d}.png".replace("+", "") for i in range(-12, 12)],
        ["-3.png", "-1.png", "1.png", "3.png"],
        [f"run-2_{i}.png" for i in range(-4, 4)],
        ["x_-0.5.png", "x_-0.25.png", "x_0.0.png", "x_0.25.png"],
        [f"frame-{i}.png" for i in range(12)],
        [f"depth_test_{i}.png" for i in range(4)],
        ["肝.png", "胃.png"],
        [f"part1_{i}.png" for i in range(4)] + [f"part2_{i}.png" for i in range(4)],
        [f"intro_{i}.png" for i in range(4)] + [f"main_{i}.png" for i in range(4, 40)],
    ],
)
def test_one_series_in_several_spellings_is_kept(names):
    files = list(map(Path, names))
    assert in_order(map(Path, sorted(names))) == files
    assert one_per_frame(FOLDER, files, "images") == (files, "")


def write(folder, names, values):
    folder.mkdir(exist_ok=True)
    for name, value in zip(names, values, strict=True):
        assert cv2.imwrite(str(folder / name), value)


def scene(count):
    """Images, and masks of a tool that moves by 3 px a frame."""
    rng = np.random.default_rng(0)
    texture = rng.integers(60, 200, (64, 96, 3)).astype(np.uint8)
    masks = [np.zeros((64, 96), np.uint8) for _ in range(count)]
    for i, mask in enumerate(masks):
        mask[10:30, 3 * i : 3 * i + 30] = 255
    return [np.where(mask[..., None] > 0, np.uint8(120), texture) for mask in masks], masks


def prepared(tmp_path, capsys, *words):
    out = tmp_path / "out"
    quick = ("--depth", "none", "--poses", "still", "--border", "keep")
    code = main(["prepare", str(tmp_path / "images"), str(out), *words, *quick])
    said = capsys.readouterr()
    return code, [cv2.imread(str(f), cv2.IMREAD_UNCHANGED) for f in sorted((out / "masks").glob("*"))], said


def test_prepare_takes_the_mask_of_each_frame(tmp_path, capsys):
    images, masks = scene(8)
    write(tmp_path / "images", [f"{i:06d}.png" for i in range(2, 6)], images[2:6])
    write(tmp_path / "m", [f"{i:06d}.png" for i in range(8)], masks)
    code, got, said = prepared(tmp_path, capsys, "--masks", str(tmp_path / "m"))
    assert code == 0 and all((a == b).all() for a, b in zip(got, masks[2:6], strict=True))
    assert "note: masks: matched by name\n" in said.out
    (tmp_path / "m/000003.png").unlink()
    for i in (0, 1, 7):
        (tmp_path / f"m/{i:06d}.png").unlink()
    (tmp_path / "m/000006.png").rename(tmp_path / "m/000008.png")
    (tmp_path / "out").rename(tmp_path / "before")
    code, _, said = prepared(tmp_path, capsys, "--masks", str(tmp_path / "m"))
    assert code == 2 and "4 files for 4 frames, none numbered 3" in said.err


def test_prepare_tells_images_from_masks_in_one_folder(tmp_path, capsys):
    images, masks = scene(5)
    names = [f"f{i}" for i in range(5)]
    write(tmp_path / "images", [f"{name}.png" for name in names], images)
    write(tmp_path / "images", [f"{name}_mask.png" for name in names], masks)
    code, got, said = prepared(tmp_path, capsys, "--masks", str(tmp_path / "images"))
    assert code == 0 and all((a == b).all() for a, b in zip(got, masks, strict=True))
    assert "5 of 10 files are images; not f#_mask.png (5)" in said.out
    assert ": 5 of 10 files are masks; not " in open_mask_folder(tmp_path / "images").note
    write(tmp_path / "images", [f"{name}.jpg" for name in names], images)
    (tmp_path / "out").rename(tmp_path / "before")
    code, _, said = prepared(tmp_path, capsys, "--masks", "none")
    assert code == 2 and "got f#.jpg (5), f#.png (5), f#_mask.png (5)" in said.err
