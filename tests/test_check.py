"""`endoprior check`: each defect of a phantom is reported with its fix; a good sequence gives no findings."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sequence_edits import change_poses, describe, edit

from endoprior.check import Facts, Finding, draw_check, find, measure
from endoprior.check.report import as_json, table
from endoprior.cli import main
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.data.found_tools import FrameRow, write_rows
from endoprior.footage.depth_unit import guess_unit
from endoprior.footage.round_border import Circle
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.view.mask_editor import MaskEdits

FRAMES, WIDTH, HEIGHT = 12, 256, 192


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A phantom of both cameras, left as it is."""
    folder = tmp_path_factory.mktemp("check") / "phantom"
    write_phantom(folder, PhantomConfig(frames=FRAMES, width=WIDTH, height=HEIGHT, stereo=True))
    shutil.rmtree(folder / "truth")
    return folder


@pytest.fixture(scope="module")
def facts(whole: Path) -> Facts:
    return measure(load_sequence(whole))


@pytest.fixture
def stereo(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "data"))


@pytest.fixture
def data(whole: Path, tmp_path: Path) -> Path:
    """A copy of the phantom's left camera to break."""
    return Path(shutil.copytree(whole, tmp_path / "data", ignore=shutil.ignore_patterns("right")))


def test_overexposed_tissue_is_named_with_its_share_and_frames(data, facts):
    assert "overexposed" not in {finding.code for finding in find(facts)}

    def whiten(image, position):
        if position in (2, 3):
            image[60:130, 60:190] = 255
        return image

    edit(data / "images", whiten)
    sequence = load_sequence(data)
    found = {finding.code: finding for finding in find(measure(sequence))}["overexposed"]
    tissue = [sequence.frame(i).tissue_mask for i in (2, 3)]
    share = np.mean([mask[60:130, 60:190].sum() / mask.sum() for mask in tissue])
    assert (found.severity, found.frames) == ("warning", (2, 3))
    assert found.what == f"{share:.0%} of the tissue is overexposed, in frames 2-3: its color is a guess"


@pytest.mark.slow
def test_frames_of_uncertain_masks_are_named_and_shown(data, tmp_path, monkeypatch):
    confidence = [0.9, 0.4, 0.8, 0.3] + [0.45 + 0.001 * i for i in range(5)] + [0.9] * 3
    write_rows(data, [FrameRow(i, 0.1, value) for i, value in enumerate(confidence)])
    titles = []
    monkeypatch.setattr(Axes, "set_title", lambda self, text, **style: titles.append(text))
    sequence = load_sequence(data)
    facts = measure(sequence)
    found = find(facts)
    (finding,) = (finding for finding in found if finding.code == "uncertain-masks")
    assert finding.frames == (1, 3, 4, 5, 6, 7, 8) and "frames 1, 3-8" in finding.what
    assert f"endoprior view {data}" in finding.fix
    draw_check(sequence, facts, found, tmp_path / "unsure.png")
    shown = [title for title in titles if "unsure" in title]
    assert shown == [f"frame {i}: unsure, {confidence[i]:.2f}" for i in (3, 1, 4, 5, 6, 7)]
    strided = measure(load_sequence(data, DataConfig(stride=3)))
    assert np.allclose(strided.masks.confidence, confidence[::3])
    # A correction in the viewer ends the doubt.
    edits = MaskEdits(sequence)
    for frame in finding.frames:
        edits.begin()
        edits.draw(frame, [(20, 20)], 3, True)
    edits.save()
    assert "uncertain-masks" not in findings(data)


def findings(folder: Path) -> dict[str, Finding]:
    found = find(measure(load_sequence(folder)))
    assert all("\n" not in str(finding) for finding in found)
    return {finding.code: finding for finding in found}


def only(folder: Path, code: str) -> Finding:
    found = findings(folder)
    assert list(found) == [code]
    return found[code]


COMMANDS = re.compile(r"`--data\.(\S+) (\S+)`")
EDIT = re.compile(r"(?:set|write) {?(.*?)}? (?:in|to) \S+/sequence\.json")


def changed(folder: str, change: Callable) -> Callable[[Path], object]:
    return lambda data: edit(data / folder, change)


def write_a_name(image: np.ndarray, position: int) -> np.ndarray:
    image[5:27, 150:240] = 0
    return cv2.putText(image, "SMITH J", (154, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2)


def double_the_rate(data: Path) -> None:
    files = sorted((data / "images").iterdir())
    for copy in range(1, FRAMES, 2):
        shutil.copy(files[copy - 1], files[copy])


INSIDE = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), (WIDTH // 2, HEIGHT // 2), 120, 1, -1)[..., None]
IN_DISPARITY = changed("depth", lambda z, _: np.where(z > 0, 4e7 / np.maximum(z, 1), 0).astype(np.uint16))
BRIGHTER = changed("images", lambda p, i: np.clip(p * (1.4 if i >= 11 else 1.0), 0, 255).astype(np.uint8))
METERS = "depth looks like m, not mm (the median is 0.07772, which in m is 78 mm away)"
IN_MM = 'set "depth_scale": 0.01 in DATA/sequence.json, or train with `--data.depth-unit-mm 0.01`'
USUAL = 'set "fx": 230.4, "fy": 230.4, "cx": 128, "cy": 96 in DATA/sequence.json'
NO_TOOLS = "nothing if no tool is in view; else find them: `endoprior masks DATA`, or paint "
DEFECTS = {
    "error: mask-polarity: tissue and tool": (changed("masks", lambda m, _: 255 - m), 'set "mask_tool_value": 0 in', 1),
    f"error: depth-metres: {METERS}": (lambda data: describe(data, depth_scale=1e-5), IN_MM, 2),
    "warning: intrinsics: fx 2880, fy 2880,": (lambda data: describe(data, fx=2880.0, fy=2880.0), USUAL, 1),
    "error: depth-disparity: ": (IN_DISPARITY, "store depth in mm: focal length (px) x", 0),
    "warning: round-border: the image is round (radius 120": (
        changed("images", lambda image, _: image * INSIDE),
        "run `prepare` with `--border auto`",
        0,
    ),
    "warning: burned-in-text: burned-in": (changed("images", write_a_name), "run `prepare` with `--blank ", 0),
    "warning: duplicate-frames: 6 of 12 frames": (double_the_rate, "train with `--data.stride 2`", 1),
    "warning: exposure-jump: the brightness of": (BRIGHTER, "train with `--data.first-frames 11`", 1),
    "warning: tool-fraction: no tools were found; if": (changed("masks", lambda m, _: 0 * m), NO_TOOLS, 0),
}


@pytest.mark.parametrize("said", DEFECTS)
def test_a_defect_is_found_and_what_its_fix_says_ends_it(data, said):
    """Every edit of `sequence.json` and every `--data` option that a fix names."""
    defect, fix, ways = DEFECTS[said]
    code, done = said.split(": ")[1], 0
    defect(data)
    finding = only(data, code)
    assert str(finding).startswith(said)
    assert finding.fix.startswith(fix.replace("DATA", str(data)))
    for name, value in COMMANDS.findall(finding.fix):
        key = name.replace("-", "_")
        cfg = DataConfig(**{key: type(getattr(DataConfig(), key))(value)})
        assert code not in {finding.code for finding in find(measure(load_sequence(data, cfg), cfg))}
        done += 1
    if values := EDIT.search(finding.fix):
        describe(data, **json.loads("{" + values[1] + "}"))
        assert code not in findings(data)
        done += 1
    assert done == ways


def test_windows_and_their_cost(facts):
    """A note only where there is more than one; twice the pixels cost nearly twice the time."""
    assert facts.windows == ((0, FRAMES),)
    cut = replace(facts, windows=((0, 60), (50, 110), (100, 150)))
    wide = replace(cut, camera=replace(facts.camera, width=1280, height=1024), camera_path_mm=50.0)
    one, far = (next(note for note in find(each) if note.code == "windows") for each in (cut, wide))
    assert one.severity == "note" and "a long video: it is trained in 3 windows of 50 to 60 frames" in one.what
    minutes = [int(re.search(r"about (\d+) min", note.what)[1]) for note in (one, far)]
    assert "the camera moves far" in far.what and 3 < minutes[1] / minutes[0] < 12


def test_a_good_sequence_gives_no_findings(facts):
    assert find(facts) == []
    assert len(facts.cloud) > 10_000 and facts.stereo.order.as_given > 0.8


@pytest.mark.slow
def test_the_real_clip_gives_no_findings(real_clip):
    cfg = DataConfig(stride=6)
    assert find(measure(load_sequence(real_clip, cfg), cfg)) == []


@pytest.mark.parametrize(
    ("factor", "code", "fix"),
    [(0.1, "depth-centimetres", "0.1"), (10, "depth-unit", "0.001"), (1e-4, "depth-unit", "MM_PER_UNIT")],
)
def test_depth_in_other_units(facts, factor, code, fix):
    everywhere = np.ones((9, 9), bool)
    guess = guess_unit([(np.full((9, 9), 78 * factor), everywhere, np.zeros((9, 9, 3), np.uint8), everywhere)])
    (finding,) = find(replace(facts, depth=replace(facts.depth, unit=guess)))
    assert finding.code == code and f'"depth_scale": {fix} in' in finding.fix


def test_depth_of_8_bits(data):
    edit(data / "depth", lambda depth, _: np.rint(depth / 100).astype(np.uint8))
    describe(data, depth_scale=1.0)
    assert only(data, "depth-8-bit").what == "8 bits a value, steps of 1 mm"


def test_console_strip(data):
    def paint(image: np.ndarray, position: int) -> np.ndarray:
        image[-20:] = 45
        cv2.putText(image, "OR 2", (150, HEIGHT - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (220, 220, 220), 1)
        return image

    edit(data / "images", paint)
    finding = only(data, "console-strip")
    assert finding.what == "a bar or console strip of 20 px at the bottom counts as tissue"
    assert finding.fix == "run `prepare` with `--crop X,Y,WIDTH,HEIGHT`, without it, or mark it in the masks"
    edit(data / "masks", lambda mask, _: np.vstack([mask[:-20], np.full_like(mask[-20:], 255)]))
    assert findings(data) == {}, "the strip is masked now"


@pytest.mark.slow
def test_eyes_that_are_apart_or_swapped(stereo):
    edit(stereo / "right", lambda image, _: np.roll(image, 4, 0))
    assert only(stereo, "vertical-offset").what == "the rows of left and right images are 4.0 px apart"
    edit(stereo / "right", lambda image, _: np.roll(image, -4, 0))
    (stereo / "images").rename(stereo / "left")
    (stereo / "right").rename(stereo / "images")
    (stereo / "left").rename(stereo / "right")
    found = findings(stereo)
    assert found["swapped-eyes"].severity == "error"
    by_hand = f"swap the folders {stereo}/images and {stereo}/right, and measure depth again"
    assert "`--swap-eyes`" in found["swapped-eyes"].fix and found["swapped-eyes"].fix.endswith(by_hand)


def test_duplicated_frames(data):
    files = sorted((data / "images").iterdir())
    for copy in (5, 6, 11):
        shutil.copy(files[copy - 1], files[copy])
    finding = only(data, "duplicate-frames")
    assert finding.frames == (5, 6, 11)
    assert finding.what == "3 of 12 frames repeat the one before: frames 5-6, 11"
    assert finding.fix == "train with `--data.skip-frames 5-6,11`"
    given = DataConfig(shrink=2, skip_frames="2-3")
    found = {each.code: each for each in find(measure(load_sequence(data, given), given))}
    assert found["duplicate-frames"].fix == "train with `--data.skip-frames 2-3,5-6,11`"


@pytest.mark.slow
def test_moving_camera_with_static_poses(data):
    def pan(image: np.ndarray, position: int) -> np.ndarray:
        shift = np.array([[1.15, 0, -16 - 3 * position], [0, 1.15, -14]], np.float32)
        return cv2.warpAffine(image, shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)

    edit(data / "images", pan)
    finding = findings(data)["camera-moves"]
    assert finding.severity == "warning" and "--poses estimate" in finding.fix

    def moved(poses: np.ndarray) -> np.ndarray:
        poses[:, 3] = np.arange(FRAMES)  # x of the camera, mm
        return poses

    change_poses(data, moved)
    assert "camera-moves" not in findings(data), "the poses account for it"


@pytest.mark.slow
def test_frames_without_depth(data):
    edit(data / "depth", lambda depth, i: depth * np.uint16(i not in (3, 4)))
    finding = only(data, "no-depth-frames")
    assert finding.frames == (3, 4) and finding.what == "no depth on tissue in frames 3-4"
    edit(data / "depth", lambda depth, _: np.zeros_like(depth))
    finding = only(data, "no-depth-frames")
    assert finding.severity == "error" and finding.what == "no frame has depth"


def test_sparse_depth_and_depth_jumps(data):
    keep = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 4 == 0
    edit(data / "depth", lambda depth, i: depth * keep * np.uint16(2 if i == 9 else 1))
    found = findings(data)
    assert sorted(found) == ["depth-jumps", "depth-sparse"]
    assert found["depth-jumps"].what == "the median depth jumps at frames 9-10"
    assert found["depth-sparse"].what == "depth on 24% of the tissue of a usual frame"


def test_a_masked_border_is_no_tool(data, facts):
    """Black corners and a label in the image, masked in every frame, beside the tools."""
    border = ~Circle(WIDTH / 2, HEIGHT / 2, 120).mask(WIDTH, HEIGHT)
    border[90:100, 120:140] = True
    edit(data / "images", lambda image, _: np.where(border[..., None], np.uint8(0), image))
    edit(data / "masks", lambda mask, _: np.where(border, np.uint8(255), mask))
    found = measure(load_sequence(data))
    assert found.border.masked.mean() == pytest.approx(border.mean(), abs=0.01)
    tools = [(~frame.tissue_mask & ~border).sum() / (~border).sum() for frame in load_sequence(data).frames("video")]
    assert found.masks.tool_fraction == pytest.approx(np.array(tools), abs=0.01) and min(tools) > 0.01
    assert find(found) == []
    assert as_json(found, [])["facts"]["border"]["masked"] == found.border.masked.mean()


def test_masks_of_the_border_alone_hold_no_tools(data):
    border = ~Circle(WIDTH / 2, HEIGHT / 2, 120).mask(WIDTH, HEIGHT)
    edit(data / "images", lambda image, _: np.where(border[..., None], np.uint8(0), image))
    edit(data / "masks", lambda mask, _: np.where(border, np.uint8(255), np.uint8(0)))
    describe(data, sources={"masks": "no tools found"})
    facts = measure(load_sequence(data))
    assert not facts.masks.tool_fraction.any()
    (finding,) = find(facts)
    assert (finding.code, finding.severity) == ("tool-fraction", "warning")
    assert "the masks cover only the border; if tools are in view, they become tissue" in finding.what
    assert finding.fix.endswith(f"else paint them: `endoprior view {data}`, or run `prepare` with `--masks FOLDER`")


def test_relative_lengths_are_not_called_mm(facts):
    relative = replace(facts, depth=replace(facts.depth, relative=True), camera_path_mm=5.0)
    rows = dict(table(relative))
    assert rows["camera"].startswith("moves up to 5 rel.") and rows["depth"].endswith(" rel.")
    assert "mm" not in " ".join(rows.values())
    assert " mm" in dict(table(facts))["depth"]


@pytest.mark.slow
@pytest.mark.parametrize("is_relative", [False, True])
def test_no_text_of_the_figure_is_cut_off(facts, whole, tmp_path, monkeypatch, is_relative):
    shown, save = [], Figure.savefig

    def record(figure, *args, **options):
        save(figure, *args, **options)
        axes_texts = [
            text for axes in figure.findobj(Axes) for text in (axes.title, axes.xaxis.label, axes.yaxis.label)
        ]
        shown.extend(text for text in axes_texts if text.get_text())
        page = figure.bbox
        for text in shown:
            box = text.get_window_extent()
            assert page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1, text

    monkeypatch.setattr(Figure, "savefig", record)
    facts = replace(facts, depth=replace(facts.depth, relative=is_relative))
    draw_check(load_sequence(whole), facts, find(facts), tmp_path / "check.png")
    lengths = [text.get_text() for text in shown if "distance" in text.get_text() or "median" in text.get_text()]
    assert len(lengths) >= 2 and all(("rel." in text) == is_relative for text in lengths)


def test_blurred_frames_and_few_frames(data):
    for folder in ("images", "masks", "depth"):
        for file in sorted((data / folder).iterdir())[8:]:
            file.unlink()
    change_poses(data, lambda poses: poses[:8])
    edit(data / "images", lambda p, i: cv2.GaussianBlur(p, (0, 0), 5) if i == 4 else p)
    found = findings(data)
    assert sorted(found) == ["few-frames", "unexplained-frames"]
    assert found["few-frames"].what == "8 frames, 1 of them to test"
    assert found["unexplained-frames"].frames == (4,)


def test_where_no_frame_has_a_pose_nothing_is_said_to_be_left_out(facts):
    moving = replace(facts.motion, path_px=facts.motion.path_px + 99)
    described = facts.described | {"unexplained_frames": list(range(facts.frames))}
    lost = replace(facts, described=described, sources={"camera motion": "unknown"}, motion=moving)
    found = {finding.code: finding for finding in find(lost)}
    assert (
        "as if each had a pose" in found["unexplained-frames"].what
        and "another part" in found["unexplained-frames"].fix
    )
    assert "how the camera moves is unknown" in found["camera-unknown"].what and "camera-moves" not in found


def test_findings_from_edited_facts(facts):
    relative = find(replace(facts, depth=replace(facts.depth, relative=True)))
    assert [(f.code, f.severity) for f in relative] == [("relative-depth", "note")]
    assert [f.code for f in find(replace(facts, notes=("odd",), cloud=None))] == ["no-points", "reader"]
    much = find(replace(facts, masks=replace(facts.masks, tool_fraction=np.full(FRAMES, 0.7))))
    assert [f.what for f in much] == ["70% of the pixels inside the border are tool"]
    cut = find(replace(facts, changes=replace(facts.changes, cuts=(3,))))
    assert [f.fix for f in cut] == ["train with `--data.skip-frames 0-2`"]
    for left in (0, 1):  # a command that leaves out (nearly) all frames would only fail
        (odd,) = find(replace(facts, changes=replace(facts.changes, blurred=tuple(range(FRAMES - left)))))
        assert odd.fix == f"look at the images in {facts.path}: they may not be one video of one scene"


def test_command_prints_and_writes_figure_and_json(data, capsys):
    describe(data, depth_scale=1e-5)
    out, facts = data.parent / "new" / "check.png", data.parent / "check.json"
    assert main(["check", str(data), "--out", str(out), "--json", str(facts)]) == 0
    text = capsys.readouterr().out.splitlines()
    assert text[0] == str(data) and text[-1] == f"figure: {out}"
    assert sum(line.startswith("error: depth-metres: ") for line in text) == 1
    assert any(line.split()[:2] == ["frames", "12:"] for line in text)
    assert cv2.imread(str(out)).shape == (1400, 1500, 3)
    stored = json.loads(facts.read_text())
    assert stored["facts"]["frames"] == FRAMES and len(stored["facts"]["masks"]["tool_fraction"]) == FRAMES
    assert [finding["code"] for finding in stored["findings"]] == ["depth-metres"]
    assert sorted(path.name for path in data.parent.iterdir()) == ["check.json", "data", "new"]


@pytest.mark.slow
def test_exit_statuses(data, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["check", str(data), "--strict"]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == ["no problems found", f"figure: {data}_check.png"]
    assert Path(f"{data}_check.png").exists()
    assert main(["check", str(data), "--data.depth-unit-mm", "0.00001", "--strict"]) == 2
    assert "error: depth-metres" in capsys.readouterr().out
    assert main(["check", str(data), "--out", str(tmp_path / "check.txt")]) == 2
    fix = f"Fix: `--out {tmp_path}/check.png`."
    assert capsys.readouterr().err == f"endoprior: --out: expected a .png file, got {tmp_path}/check.txt. {fix}\n"
    (data / "images" / "000003.png").write_bytes(b"nothing")
    assert main(["check", str(data)]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and "000003.png" in said.err
    assert main(["check", str(tmp_path / "nowhere")]) == 2
