"""Every fix that `check` prints is carried out, and the problem is gone after it.

Commands stand in backticks and are run by the command line; `train` commands by `check` with their data options. Edits
name a key, a value and a JSON file.
"""

import json
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from sequence_edits import change_poses, describe, edit
from video_files import write_video

from endoprior.check import Facts, Finding, find, measure
from endoprior.cli import main
from endoprior.cli.arguments import parse
from endoprior.cli.check import Check
from endoprior.data import load_sequence
from endoprior.phantom import PhantomConfig, write_phantom

FRAMES, WIDTH, HEIGHT = 16, 256, 192
RANK = {"note": 0, "warning": 1, "error": 2}
COMMAND = re.compile(r"`(endoprior .*?)`")
EDIT = re.compile(r"set (.*) in (\S+/sequence\.json)|write \{(.*)\} to (\S+/sequence\.json)")
DECISIONS = {
    "few-frames": "more frames must be recorded",
    "relative-depth": "nothing is wrong unless mm are needed",
    "calibration-size": "only the user knows for which images the endoscope was calibrated",
    "no-points": "masks or depth are wrong in a way that the figure shows",
    "reader": "the note itself says what is unusual",
    "windows": "nothing is wrong",
    "video": "the note itself says what is particular about the video",
    "dark-images": "the missing bits are not in the images any more",
    "uncertain-masks": "only a person sees which pixels are tool",
}
"""Problems that no command solves, with the reason."""

pytestmark = pytest.mark.usefixtures("all_vessels")


def written(folder: Path, stereo: bool) -> Path:
    """A phantom without its truth."""
    write_phantom(folder, PhantomConfig(frames=FRAMES, width=WIDTH, height=HEIGHT, stereo=stereo))
    shutil.rmtree(folder / "truth")
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A phantom of one camera, left as it is."""
    return written(tmp_path_factory.mktemp("fixes") / "phantom", stereo=False)


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> Path:
    """A phantom of both cameras, left as it is."""
    return written(tmp_path_factory.mktemp("fixes") / "both", stereo=True)


@pytest.fixture
def data(whole: Path, tmp_path: Path) -> Path:
    """A copy of the phantom to break, in a folder whose name needs quotes."""
    return Path(shutil.copytree(whole, tmp_path / "my data"))


@pytest.fixture
def stereo(both: Path, tmp_path: Path) -> Path:
    """The same with both cameras."""
    return Path(shutil.copytree(both, tmp_path / "my data"))


@pytest.fixture(scope="module")
def facts(whole: Path) -> Facts:
    """What is measured of the phantom."""
    return measure(load_sequence(whole))


def check(folder: Path, *options: str) -> dict[str, Finding]:
    """What `check` reports, by code."""
    args = parse(Check, [str(folder), *options], "check")
    return {finding.code: finding for finding in find(measure(load_sequence(args.folder, args.data), args.data))}


def follow(capsys, folder: Path, fix: str) -> list[dict[str, Finding]]:
    """What `check` reports after each way to follow a fix: its edit, and each of its commands."""
    reports = []
    for text in COMMAND.findall(fix):
        program, command, *words = shlex.split(text)
        assert program == "endoprior" and command in ("prepare", "train")
        if command == "prepare":
            assert main([command, *words]) == 0, f"{text}: {capsys.readouterr().err}"
            reports.append(check(Path(words[1])))
        else:
            assert words[:2] == [str(folder), "RUN"]
            reports.append(check(folder, *words[2:]))
    if change := EDIT.search(COMMAND.sub("", fix).replace(f"{folder}/", "FOLDER/")):
        values = json.loads("{%s}" % (change[1] or change[3]))
        file = folder / "sequence.json"
        assert (change[3] is not None) != file.exists()
        before = file.read_text() if file.exists() else "{}"
        file.write_text(json.dumps(json.loads(before) | values))
        reports.append(check(folder))
    return reports


def assert_fixed(capsys, folder: Path, code: str, ways: int = 1, *options: str) -> list[dict[str, Finding]]:
    """The fix of a problem works: it is gone, and no problem is there that was not, or that is worse.

    Args:
        ways: number of edits and commands in the fix.
        options: of `check`, before the fix.
    """
    before = check(folder, *options)
    reports = follow(capsys, folder, before[code].fix)
    assert len(reports) == ways, before[code].fix
    for after in reports:
        assert code not in after, f"{before[code].fix}: {after.get(code)}"
        severest = RANK[before[code].severity]
        new = {name: found for name, found in after.items() if name not in before}
        assert all(RANK[found.severity] < severest for found in new.values()), new
    return reports


def no_tools(data):
    edit(data / "masks", lambda mask, _: np.zeros_like(mask))


def many_tools(data):
    # The whole left and the rows below: of the tissue only a corner is left.
    edit(data / "masks", lambda mask, _: np.maximum(mask, np.tri(HEIGHT, WIDTH, 60, np.uint8) * np.uint8(255)))


def inverted(data):
    edit(data / "masks", lambda mask, _: 255 - mask)


def in_meters(data):
    describe(data, depth_scale=1e-5)


def disparity(data):
    edit(data / "depth", lambda depth, _: np.where(depth > 0, 4e7 / np.maximum(depth, 1), 0).astype(np.uint16))


def eight_bits(data):
    edit(data / "depth", lambda depth, _: np.rint(depth / 100).astype(np.uint8))
    describe(data, depth_scale=1.0)


def no_depth(data):
    edit(data / "depth", lambda depth, _: np.zeros_like(depth))


def gaps_in_depth(data):
    edit(data / "depth", lambda depth, i: depth * np.uint16(i not in (3, 4)))


def sparse(data):
    keep = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 4 == 0
    edit(data / "depth", lambda depth, _: depth * keep)


def filled(data):
    def fill(depth: np.ndarray, position: int) -> np.ndarray:
        if position in (3, 4):
            depth[20:60, 20:60] = np.arange(30000, 34000, 100)
        return depth

    edit(data / "depth", fill)


def jumps(data):
    edit(data / "depth", lambda depth, i: depth * np.uint16(2 if i == 9 else 1))


def strip(data):
    edit(data / "images", painted_strip)


def painted_strip(image: np.ndarray, position: int) -> np.ndarray:
    """A console strip of a tenth of the height at the bottom."""
    height, width = image.shape[:2]
    image[-height // 10 :] = 45
    cv2.putText(image, "OR 2", (width // 2, height - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (220, 220, 220), 1)
    return image


def round_image(data):
    inside = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    cv2.circle(inside, (WIDTH // 2, HEIGHT // 2), 120, 1, -1)
    edit(data / "images", lambda image, _: image * inside)


def labelled(data):
    def paint(image: np.ndarray, position: int) -> np.ndarray:
        image[5:27, 150:240] = 0
        cv2.putText(image, "SMITH J", (154, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2)
        return image

    edit(data / "images", paint)


def wrong_camera(data):
    describe(data, fx=2880.0, fy=2880.0)


def copied(*copies: int) -> Callable[[Path], None]:
    def change(data: Path) -> None:
        files = sorted((data / "images").iterdir())
        for copy in copies:
            shutil.copy(files[copy - 1], files[copy])

    return change


def doubled(data):
    for name in ("images", "masks", "depth"):
        for file in sorted((data / name).iterdir()):
            shutil.copy(file, file.with_name(f"{file.stem}_again.png"))
    change_poses(data, lambda poses: np.repeat(poses, 2, 0))


def brighter(first: int) -> Callable[[Path], None]:
    def change(data: Path) -> None:
        edit(data / "images", lambda p, i: np.clip(p * (1.4 if i >= first else 1.0), 0, 255).astype(np.uint8))

    return change


def cut(data):
    edit(data / "images", lambda p, i: np.ascontiguousarray(p[::-1, ::-1]) if i >= 11 else p)


def blurred(data):
    edit(data / "images", lambda p, i: cv2.GaussianBlur(p, (0, 0), 5) if i == 4 else p)


def pan(data):
    def move(image: np.ndarray, position: int) -> np.ndarray:
        shift = np.array([[1.15, 0, -16 - 3 * position], [0, 1.15, -14]], np.float32)
        return cv2.warpAffine(image, shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)

    edit(data / "images", move)


def swap(data):
    (data / "images").rename(data / "left")
    (data / "right").rename(data / "images")
    (data / "left").rename(data / "right")


def low_right(data):
    edit(data / "right", lambda image, _: np.roll(image, 4, 0))


QUICK = [
    ("mask-polarity", inverted, 1),
    ("depth-metres", in_meters, 2),
    ("console-strip", strip, 1),
    ("intrinsics", wrong_camera, 1),
    ("duplicate-frames", copied(5, 6, 11), 1),
]
SLOW = [
    ("tool-fraction", no_tools, 1),
    ("tool-fraction", many_tools, 1),
    ("depth-disparity", disparity, 1),
    ("depth-8-bit", eight_bits, 1),
    ("no-depth-frames", no_depth, 1),
    ("no-depth-frames", gaps_in_depth, 1),
    ("depth-sparse", sparse, 1),
    ("depth-jumps", jumps, 1),
    ("depth-far", filled, 1),
    ("round-border", round_image, 1),
    ("burned-in-text", labelled, 1),
    ("camera-moves", pan, 1),
    ("duplicate-frames", doubled, 1),
    ("exposure-jump", brighter(11), 1),
    ("exposure-jump", brighter(4), 1),
    ("scene-cut", cut, 1),
    ("unexplained-frames", blurred, 1),
]


@pytest.mark.parametrize(
    ("code", "damage", "ways"), [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)]
)
def test_the_fix_of_a_sequence(data, capsys, code, damage, ways):
    damage(data)
    assert_fixed(capsys, data, code, ways)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "damage"),
    [("swapped-eyes", swap), ("vertical-offset", low_right), ("depth-sparse", sparse), ("no-depth-frames", no_depth)],
)
def test_the_fix_of_a_stereo_sequence(stereo, capsys, code, damage):
    damage(stereo)
    (after,) = assert_fixed(capsys, stereo, code)
    assert after == {}
    depth = json.loads((stereo.parent / "my data_2" / "sequence.json").read_text())
    assert depth["depth_source"].startswith("stereo") and not depth["depth_relative"]


def test_every_problem_has_a_test_or_a_reason():
    text = (Path(__file__).parents[1] / "docs" / "check.md").read_text()
    listed = set(re.findall(r"`([a-z0-9-]+)`", " ".join(re.findall(r"^- (.*?) \(", text, re.MULTILINE))))
    tested = {code for code, _, _ in [*QUICK, *SLOW]} | {"swapped-eyes", "vertical-offset", "poses-convention"}
    same_code = {"depth-centimetres", "depth-unit"}  # as depth-metres, with another factor
    assert listed == tested | set(DECISIONS) | same_code
    assert not tested & set(DECISIONS)


@pytest.mark.parametrize("code", ["few-frames", "relative-depth", "no-points", "reader"])
def test_decisions_of_a_person_name_no_command(facts, code):
    changed = replace(facts, frames=5, notes=("odd",), cloud=None, depth=replace(facts.depth, relative=True))
    fix = {finding.code: finding.fix for finding in find(changed)}[code]
    assert "`" not in fix


def test_an_edit_of_a_folder_without_a_description(data, capsys):
    inverted(data)
    (data / "sequence.json").unlink()
    fix = check(data)["depth-unit"].fix  # 0.01 mm, read as mm
    assert fix.startswith('write {"depth_scale": 0.01} to ')
    (data / "depth").rename(data.parent / "depth")  # the camera is not tested here
    edit(data.parent / "depth", lambda depth, _: np.rint(depth / 100).astype(np.uint16))
    (data.parent / "depth").rename(data / "depth")
    assert_fixed(capsys, data, "mask-polarity")


@pytest.mark.slow
def test_fixes_repeat_the_options_of_the_check(data, capsys):
    copied(6, 7, 14)(data)
    options = ["--data.shrink", "2", "--data.skip-frames", "2-3"]
    fix = check(data, *options)["duplicate-frames"].fix
    assert fix.endswith("--data.shrink 2 --data.skip-frames 2-3,6-7,14`")
    assert_fixed(capsys, data, "duplicate-frames", 1, *options)
    strip(data)
    assert "--crop 0,0,256,17" in check(data, *options)["console-strip"].fix


@pytest.mark.slow
def test_the_printed_train_command_trains(data, capsys, monkeypatch):
    monkeypatch.chdir(data.parent)
    copied(5, 6)(data)
    (text,) = COMMAND.findall(check(data)["duplicate-frames"].fix)
    quick = ["--schedule.fine-iterations", "2", "--init-budget", "200", "--no-networks"]
    assert main([*shlex.split(text)[1:], *quick]) == 0
    assert json.loads((data.parent / "RUN" / "config.json").read_text())["data"]["frames"] == FRAMES - 2


LENS = {"K": [[460.0, 0, 255.5], [0, 460.0, 191.5], [0, 0, 1]], "D": [-0.08, 0.01, 0, 0, 0]}
"""A lens that bends the edge of a 512x384 image by several px."""


def source_video(whole: Path, folder: Path) -> Path:
    """The phantom at twice its size, with a console strip at the bottom, as a video."""
    images = [cv2.imread(str(file))[..., ::-1] for file in sorted((whole / "images").iterdir())]
    large = [cv2.resize(image, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_CUBIC) for image in images]
    return write_video(folder / "my clip.mkv", [painted_strip(image, 0) for image in large])


@pytest.mark.slow
@pytest.mark.parametrize("lens", [False, True])
@pytest.mark.parametrize("crop", [None, "20,10,490,374"])
def test_a_prepared_video_is_cropped_in_pixels_of_the_video(whole, tmp_path, capsys, monkeypatch, lens, crop):
    video, data = source_video(whole, tmp_path), tmp_path / "data"
    monkeypatch.chdir(tmp_path)
    words = ["prepare", video.name, "data", "--border", "keep", "--max-width", "256", "--end", "0.5"]
    words += ["--masks", "none"]  # the gray strip would pass as a tool
    words += ["--crop", crop] if crop else []
    if lens:
        (tmp_path / "lens.json").write_text(json.dumps(LENS))
        words += ["--calibration", "lens.json"]
    assert main(words) == 0, capsys.readouterr().err
    fix = check(data)["console-strip"].fix
    assert f"`endoprior prepare '{video}' {data}_2 " in fix and "--end 0.5" in fix
    assert not lens or f"--calibration {tmp_path}/lens.json" in fix
    assert_fixed(capsys, data, "console-strip")
    x, y, width, height = map(int, re.search(r"--crop (\d+),(\d+),(\d+),(\d+)", fix).groups())
    # What was there is kept but for the strip, which begins at row 345 of the video.
    whole_crop = tuple(map(int, crop.split(","))) if crop else (0, 0, 512, 384)
    lost = 12 if lens else 0  # the rectification cuts off the rim
    assert whole_crop[0] <= x <= whole_crop[0] + lost and whole_crop[1] <= y <= whole_crop[1] + lost
    assert width >= whole_crop[2] - 2 * lost and 345 - 12 <= y + height <= 345 + 2
    size = json.loads((tmp_path / "data_2" / "sequence.json").read_text())
    assert size["width"] == 256, "the crop has the resolution of the video"


@pytest.mark.slow
def test_a_prepared_sequence_whose_video_is_gone_is_made_from_its_frames(whole, tmp_path, capsys):
    video, data = source_video(whole, tmp_path), tmp_path / "data"
    words = ["prepare", str(video), str(data), "--border", "keep", "--max-width", "256", "--end", "0.5"]
    assert main([*words, "--masks", "none"]) == 0
    video.unlink()
    fix = check(data)["console-strip"].fix
    assert f"`endoprior prepare {data}/images {data}_2 " in fix and "--crop 0,0,256,17" in fix
    assert_fixed(capsys, data, "console-strip")


@pytest.mark.slow
def test_vertical_offset_of_a_video_moves_the_rows_then_asks_for_the_calibration(stereo, capsys):
    low_right(stereo)
    words = [stereo / "images", stereo.parent / "pair", "--right", stereo / "right"]
    options = ["--calibration", stereo / "calibration.json", "--keep-right"]
    assert main(["prepare", *map(str, words), *map(str, options)]) == 0
    assert_fixed(capsys, stereo.parent / "pair", "vertical-offset")
    low_right(stereo.parent / "pair_2")
    fix = check(stereo.parent / "pair_2")["vertical-offset"].fix
    assert "--calibration FILE" in fix and str(stereo / "calibration.json") not in fix
