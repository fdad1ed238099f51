"""Relative depth gets mm: known lengths, files of a folder, `endoprior scale`, and `prepare`."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from view_client import Client, at_work, wait_until

from endoprior.check import find, measure
from endoprior.check.report import table
from endoprior.cli import main
from endoprior.cli.view import open_viewable
from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import edit, load_sequence
from endoprior.data.edit import finish_scale, write_scale
from endoprior.data.images import save_png
from endoprior.data.scale import (
    SHAPE_STD,
    Scale,
    length_std,
    parse_known_length,
    relative_length,
    robust_mean,
    scale_between,
    scale_by_lengths,
)
from endoprior.data.writer import FrameFiles, SequenceMeta, new_sequence
from endoprior.prepare import prepare
from endoprior.prepare.camera_path.path import CameraPath
from endoprior.prepare.camera_path.tracks import FrameReader
from endoprior.prepare.config import PrepareConfig
from endoprior.prepare.folder_path import write_folder_path
from endoprior.prepare.scale import use_scale
from endoprior.view.panel import status
from endoprior.view.server import Viewer
from endoprior.view.viewable import ViewSettings

WIDTH, HEIGHT, COUNT = 64, 48, 4
MATRIX = np.array([[80.0, 0, 32.0], [0, 80.0, 24.0], [0, 0, 1]])
TOOL = np.zeros((HEIGHT, WIDTH), bool)
TOOL[40:, :20] = True
LENGTH = "1,12,24,52,24,25"  # 40 px apart at a depth of 50: 25 units
POSE = np.eye(4)
POSE[:3, 3] = 1, 2, 3


def slanted(x, y):
    """Depth of a plane in relative units."""
    return 50 + 0 * x + 0.2 * (y - 24)


@pytest.fixture
def folder(tmp_path):
    """A sequence with relative depth, poses, a record of the path and known points."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    meta = SequenceMeta(WIDTH, HEIGHT, 80, 80, 32, 24, 25.0, depth_source="shading", depth_relative=True)
    rng = np.random.default_rng(0)
    with new_sequence(tmp_path / "DATA", meta) as files:
        for _ in range(COUNT):
            rgb = rng.integers(60, 190, (HEIGHT, WIDTH, 3)).astype(np.uint8)
            files.add(rgb, TOOL, slanted(x, y).astype(np.float32))
        files.camera_to_world = np.stack([POSE] * COUNT)
        record = {"method": "our own tracks", "translation_std_mm": [0.1, None, 0.2, 0.3], "depth_scale": [1.0] * COUNT}
        files.write_json("camera_path.json", record)
        tracks = {"points": np.ones((COUNT, 2, 3), np.float32), "visible": np.ones((COUNT, 2), bool), "paired": False}
        files.write_arrays("truth/tracks.npz", **tracks)
    return tmp_path / "DATA"


def described(folder):
    return json.loads((folder / "sequence.json").read_text())


def contents(folder):
    """Bytes of every file."""
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def read(index):
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return slanted(x, y).astype(np.float32), TOOL


def test_a_known_length_in_closed_form():
    units, std = relative_length(parse_known_length(LENGTH), *read(1), MATRIX)
    # Pixel 24 covers 24..25, so that depth there is that of its center.
    assert units == pytest.approx(40 / 80 * slanted(0, 24.5), rel=1e-6)
    relief = (0.08 * 80 / 40) ** 2 / 2
    assert std == pytest.approx(np.sqrt(0.12**2 + 2 * (1.5 / 40) ** 2 + relief**2))
    assert length_std(400, 600) < 0.125 and length_std(50, 600) > 0.4, "short lengths say little"
    down, _ = relative_length(parse_known_length("0,32,10.5,32,40.5,9"), *read(0), MATRIX)
    ends = [slanted(0, y) * np.array([0, (y - 24) / 80, 1]) for y in (10.5, 40.5)]
    assert down == pytest.approx(np.linalg.norm(ends[0] - ends[1]), rel=1e-5)


def test_several_lengths_are_averaged_and_their_spread_is_the_error():
    texts = [f"{i % 4},12,24,52,24,{mm}" for i, mm in enumerate((50, 51, 49, 50, 50, 200))]
    one, five, six = (
        scale_by_lengths([parse_known_length(t) for t in texts[:n]], read, COUNT, MATRIX) for n in (1, 5, 6)
    )
    assert one.source == "known length in frame 0" and five.source == "5 known lengths in frames 0-3"
    assert five.factor == pytest.approx(50 / 25.0625, rel=1e-3) and one.error > SHAPE_STD > five.error > 0.01
    assert six.factor == pytest.approx(five.factor, rel=0.15), "one that is four times too long hardly counts"
    assert six.error > 1.5 * five.error
    wide = robust_mean(np.array([0.0, 0.4, -0.4, 0.2, -0.2]), np.full(5, 0.1))[1]
    assert wide > 0.1 > robust_mean(np.zeros(5), np.full(5, 0.1))[1]


def test_everything_that_has_a_length_becomes_mm(folder):
    before, sequence = contents(folder), load_sequence(folder)
    assert sequence.depth_is_relative and sequence.depth_is_guessed and sequence.scale is None
    write_scale(folder, Scale(2.5, 0.07, "known length in frame 1"))
    after, scaled = contents(folder), load_sequence(folder)
    assert not scaled.depth_is_relative and scaled.depth_is_guessed and scaled.scale.error == 0.07
    for i in range(COUNT):
        assert scaled.frame(i).depth == pytest.approx(2.5 * sequence.frame(i).depth, rel=1e-5)
        assert scaled.camera(i).world_to_camera[:3, 3] == pytest.approx(-2.5 * POSE[:3, 3])
    table = np.load(folder / "poses_bounds.npy")
    seen = scaled.frame(0).depth[scaled.frame(0).depth > 0]
    assert (
        table[0, 15:] == pytest.approx([2.5 * slanted(0, 0.5), 2.5 * slanted(0, 47.5)]) and seen.max() <= table[0, 16]
    )
    assert table[0, [4, 9, 14]] == pytest.approx([HEIGHT, WIDTH, 80])
    assert json.loads(after["camera_path.json"])["translation_std_mm"] == [0.25, None, 0.5, 0.75]
    assert json.loads(after["camera_path.json"])["depth_scale"] == [1.0] * COUNT
    assert (np.load(folder / "truth" / "tracks.npz")["points"] == 2.5).all()
    assert {name for name in before if before[name] != after[name]} == {
        "sequence.json", "poses_bounds.npy", "camera_path.json", "truth/tracks.npz",
    }  # fmt: skip
    assert before.keys() == after.keys()


def test_a_scale_is_replaced_and_never_multiplied(folder):
    write_scale(folder, Scale(2.5, 0.07, "known length in frame 1"))
    once = contents(folder)
    write_scale(folder, Scale(2.5, 0.07, "known length in frame 1"))
    assert contents(folder) == {**once, "truth/tracks.npz": contents(folder)["truth/tracks.npz"]}
    write_scale(folder, Scale(5.0, 0.02, "known length in frame 2"))
    assert described(folder)["depth_scale"] == pytest.approx(0.05) and described(folder)["scale_factor"] == 5.0
    assert np.load(folder / "poses_bounds.npy")[0, [3, 8, 13]] == pytest.approx(5 * POSE[:3, 3])


@pytest.mark.parametrize("moved", range(4))
def test_an_interrupted_scale_is_noticed_and_finished(folder, monkeypatch, capsys, moved):
    calls, whole = [], edit.os.replace

    def replace(source, target):
        if "scale_pending" in str(source) and "partial" not in str(source):
            calls.append(source)
            if len(calls) > moved:
                raise KeyboardInterrupt
        whole(source, target)

    copy = shutil.copytree(folder, folder.with_name("COPY"))
    write_scale(copy, Scale(2.5, 0.07, "known length in frame 1"))
    monkeypatch.setattr(edit.os, "replace", replace)
    with pytest.raises(KeyboardInterrupt):
        write_scale(folder, Scale(2.5, 0.07, "known length in frame 1"))
    monkeypatch.setattr(edit.os, "replace", whole)
    with pytest.raises(InputError, match=r"a complete folder, got .* Fix: Finish it: `endoprior scale "):
        load_sequence(folder)
    assert main(["scale", str(folder)]) == 0 and "complete now" in capsys.readouterr().out
    assert not finish_scale(folder)
    ours, theirs = contents(folder), contents(copy)
    assert ours.keys() == theirs.keys() and all(ours[n] == theirs[n] for n in ours if not n.endswith(".npz"))


def test_the_command_says_what_a_unit_is_and_check_shows_it(folder, capsys):
    assert main(["scale", str(folder), "--known-length", LENGTH]) == 0
    assert "1 unit of relative depth is 0.998 mm, by known length in frame 1" in capsys.readouterr().out
    first = described(folder)
    assert main(["scale", str(folder), "--known-length", LENGTH, "--known-length", "2,12,24,52,24,25"]) == 0
    assert "2 known lengths in frames 1-2" in capsys.readouterr().out, "an option given twice"
    assert main(["scale", str(folder), "--known-length", LENGTH]) == 0
    assert described(folder)["scale_factor"] == first["scale_factor"]
    sequence = load_sequence(folder)
    facts = measure(sequence, DataConfig())
    rows = dict(table(facts))
    assert rows["depth unit"].startswith("mm: known length in frame 1; lengths in mm err by 13%")
    assert not {"relative-depth", "depth-unit"} & {finding.code for finding in find(facts)}
    write_scale(folder, Scale(20.0, 0.1, "known length in frame 1"))  # 1 m away: the user said so
    assert "depth-unit" not in {finding.code for finding in find(measure(load_sequence(folder), DataConfig()))}
    assert any("scale by known length in frame 1" in remark for remark in sequence.validate())


BAD = {
    "no such frame": (["--known-length", "9,12,24,52,24,25"], r"--known-length: expected a frame in 0\.\.3, got 9 in"),
    "outside": (["--known-length", "1,12,24,99,24,25"], "expected points within the frame of 64x48 px, got 99, 24 in"),
    "on a tool": (["--known-length", "1,5,45,52,24,25"], "expected points on tissue, got a masked pixel at 5, 45 in"),
    "no depth": (["--known-length", "3,12,24,52,24,25"], "expected points with depth, got none at 12, 24 in"),
    "no length": (["--known-length", "1,12,24,52,24,0"], "expected a length above 0, up to 1000 mm, got 0 in 1,12"),
    "negative": (["--known-length", "1,12,24,52,24,-3"], "expected a length above 0, up to 1000 mm, got -3 in 1,12"),
    "form": (["--known-length", "1,12,24,52"], "expected FRAME,X1,Y1,X2,Y2,MM, got '1,12,24,52'"),
    "not a number": (["--known-length", "1,nan,24,52,24,5"], "expected two different points"),
    "one point": (["--known-length", "1,12,24,12,24,5"], "expected two different points, got 1,12,24,12,24,5"),
    "too far": (["--known-length", "1,31,24,32,24,900"], "expected a scale of 0.02 to 50 mm per unit of"),
    "both": (["--known-length", LENGTH, "--shaft-mm", "8"], "--known-length: expected no --shaft-mm, got --shaft-mm 8"),
    "neither": ([], "expected --known-length or --shaft-mm, got neither"),
    "diameter": (["--shaft-mm", "80"], "--shaft-mm: expected a diameter of 1 to 20 mm, got 80"),
    "no shaft": (
        ["--shaft-mm", "8"],
        "expected frames with a straight shaft from the border to a tip on tissue, got none",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_used_is_one_line_and_changes_nothing(folder, capsys, name):
    if name == "no depth":
        save_png(folder / "depth" / "000003.png", np.full((HEIGHT, WIDTH), 0, np.uint16))
    before, (options, message) = contents(folder), BAD[name]
    assert main(["scale", str(folder), *options]) == 2
    error = capsys.readouterr().err
    assert message.replace("\\", "") in error and "Fix: " in error and error.count("\n") == 1
    assert contents(folder) == before


@pytest.mark.parametrize("arrays", [{"visible": np.ones(2)}, {"points": np.array(["a"])}, None])
def test_damaged_points_are_one_line_and_change_nothing(folder, arrays):
    file = folder / "truth" / "tracks.npz"
    file.write_bytes(b"damaged") if arrays is None else np.savez(file, **arrays)
    before = contents(folder)
    with pytest.raises(InputError, match=r"tracks\.npz: expected"):
        write_scale(folder, Scale(2.5, 0.07, "known length in frame 1"))
    assert contents(folder) == before


def test_folders_that_are_in_mm_or_without_tools(folder, capsys):
    for file in (folder / "masks").iterdir():
        save_png(file, np.zeros((HEIGHT, WIDTH), np.uint8))
    assert main(["scale", str(folder), "--shaft-mm", "8"]) == 2
    assert "--shaft-mm: expected tools in the masks, got none in 4 frames" in capsys.readouterr().err
    changed = described(folder) | {"depth_relative": False}
    (folder / "sequence.json").write_text(json.dumps(changed))
    assert main(["scale", str(folder), "--known-length", LENGTH]) == 2
    assert "expected relative depth, of a video of one camera, got depth in mm" in capsys.readouterr().err
    assert main(["scale", str(folder / "none"), "--known-length", LENGTH]) == 2
    assert "none" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale_factor": 2.0}, "expected all of scale_factor, scale_error, scale_source, got only scale_factor"),
        ({"scale_factor": 2.0, "scale_error": 0.1, "scale_source": "x"}, "expected depth_relative false"),
        ({"scale_factor": 0, "scale_error": 0.1, "scale_source": "x"}, "scale_factor to be a number in"),
        ({"scale_factor": 2.0, "scale_error": -1, "scale_source": "x"}, r"scale_error to be a number in \[0, 10\]"),
        ({"scale_factor": 2.0, "scale_error": 0.1, "scale_source": ""}, "scale_source to be a text"),
    ],
)
def test_a_description_with_half_a_scale_is_an_error(folder, changes, message):
    (folder / "sequence.json").write_text(json.dumps(described(folder) | changes))
    with pytest.raises(InputError, match=message):
        load_sequence(folder)


def test_two_clicked_points_give_the_scale(folder):
    camera = load_sequence(folder).camera(0)
    points = np.array([[0.0, 0, 50], [20, 0, 50]]) + POSE[:3, 3]
    first = scale_between(points, camera, 30, 1, None, "x")
    assert first.factor == pytest.approx(1.5) and first.error > SHAPE_STD and first.source == "known length in frame 1"
    assert scale_between(points * 2, camera, 30, 1, Scale(2.0, 0.1, "y"), "x").factor == pytest.approx(1.5)
    for wrong in (0.0, -1.0, 1e5):
        with pytest.raises(InputError, match="x: expected two points and a length above 0"):
            scale_between(points, camera, wrong, 1, None, "x")


def source(tmp_path, count=4):
    """A folder of images, and one of relative depth."""
    rng = np.random.default_rng(1)
    for i in range(count):
        image = cv2.GaussianBlur(rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8), (0, 0), 2)
        image = np.clip(image * (1.3, 0.5, 0.5), 0, 255).astype(np.uint8)
        for name, pixels in (("images", image), ("near", read(0)[0].astype(np.uint16))):
            (tmp_path / name).mkdir(exist_ok=True)
            save_png(tmp_path / name / f"{i:03d}.png", pixels)
    options = {"depth": str(tmp_path / "near"), "depth_relative": "depth", "masks": "none", "border": "keep"}
    return tmp_path / "images", PrepareConfig(poses="still", field_of_view_degrees=43.6, **options)


def test_prepare_writes_mm_and_without_the_option_what_it_always_wrote(tmp_path):
    images, cfg = source(tmp_path)
    plain = prepare(images, tmp_path / "plain", cfg)
    scaled = prepare(images, tmp_path / "scaled", replace(cfg, known_length=("1,12,24,52,24,25",)))
    assert not any("scale" in name for name in described(plain.out) if name != "depth_scale")
    assert described(plain.out)["depth_relative"] and described(plain.out)["depth_scale"] == 0.01
    sequence, before = load_sequence(scaled.out), load_sequence(plain.out)
    factor = sequence.scale.factor
    assert sequence.scale.source == "known length in frame 1" and not sequence.depth_is_relative
    assert sequence.frame(2).depth == pytest.approx(factor * before.frame(2).depth, rel=1e-5)
    depth = sequence.frame(1).depth
    assert depth[24, 12] * 40 / sequence.camera(0).fx == pytest.approx(25, rel=0.01)
    note = next(note for note in scaled.notes if note.startswith("scale: "))
    assert "lengths in mm err by 13%" in note and f"is {factor:.3g} mm" in note
    for name in ("depth", "images", "masks"):
        files = sorted((plain.out / name).iterdir())
        assert [file.read_bytes() for file in files] == [(scaled.out / name / f.name).read_bytes() for f in files]
    write_scale(plain.out, sequence.scale)  # what the command does, to the same end
    now, then = ({k: v for k, v in described(each.out).items() if v is not None} for each in (plain, scaled))
    assert now == then and np.allclose(*(np.load(each / "poses_bounds.npy") for each in (plain.out, scaled.out)))


def test_prepare_rejects_what_cannot_be_used(tmp_path):
    images, cfg = source(tmp_path)
    mm = {"depth_relative": "no", "depth_unit_mm": 1.0, "known_length": (LENGTH,)}
    with pytest.raises(InputError, match=r"--known-length: expected relative depth.*got depth in mm"):
        prepare(images, tmp_path / "out", replace(cfg, **mm))
    with pytest.raises(InputError, match="--known-length: expected FRAME,X1"):
        prepare(tmp_path / "none", tmp_path / "out", replace(cfg, known_length=("1,2",)))
    with pytest.raises(InputError, match=r"--known-length: expected a frame in 0\.\.3, got 7 in"):
        prepare(images, tmp_path / "out", replace(cfg, known_length=("7,12,24,52,24,25",)))
    with pytest.raises(InputError, match="--shaft-mm: expected tools in the masks"):
        prepare(images, tmp_path / "out", replace(cfg, shaft_mm=8.0))
    assert not (tmp_path / "out").exists()


def test_the_path_is_scaled_with_the_depth(folder):
    meta = SequenceMeta(WIDTH, HEIGHT, 80, 80, 32, 24, 25.0, depth_relative=True)
    files = FrameFiles(folder, meta, COUNT)
    poses = np.stack([POSE] * COUNT)
    path = CameraPath(poses, np.ones(COUNT, bool), np.ones(COUNT), translation_std=np.full(COUNT, 0.1))

    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    frames = FrameReader(lambda _i: black, lambda i: ~read(i)[1], lambda i: read(i)[0], COUNT)
    assert use_scale(files, frames, path, (), 0.0) == (path, []) and files.meta is meta
    scaled, notes = use_scale(files, frames, path, ("1,12,24,52,24,50",), 0.0)
    factor = files.meta.scale.factor
    assert scaled.camera_to_world[:, :3, 3] == pytest.approx(factor * poses[:, :3, 3]) and len(notes) == 1
    assert np.array_equal(scaled.camera_to_world[:, :3, :3], poses[:, :3, :3]) and poses[0, 0, 3] == 1
    record = json.loads((folder / "camera_path.json").read_text())
    assert record["translation_std_mm"] == [round(0.1 * factor, 5)] * COUNT
    assert files.meta.depth_scale == pytest.approx(0.01 * factor)


def test_new_poses_that_change_depth_forget_the_scale(folder, monkeypatch):
    write_scale(folder, Scale(2.5, 0.07, "known length in frame 1"))
    found = CameraPath(np.stack([POSE] * COUNT), np.ones(COUNT, bool), np.full(COUNT, 1.1))
    cameras = []

    def moved(how, frames, camera, **_):
        cameras.append(camera)
        return (found if how == "own" else None), []

    monkeypatch.setattr("endoprior.prepare.folder_path.sequence_path", moved)
    static = write_folder_path(folder, "still")
    assert load_sequence(folder).scale.factor == 2.5 and not static.relative
    done = write_folder_path(folder, "own")
    assert cameras[0].depth_is_relative, "its shape is a guess, in mm or not"
    assert done.relative and load_sequence(folder).depth_is_relative and load_sequence(folder).scale is None
    assert any("the scale (known length in frame 1) is lost" in note for note in done.notes)


def test_the_viewer_writes_the_scale_of_two_clicks(folder, capfd):
    viewable, _ = open_viewable(folder, None)
    with at_work(Viewer(viewable)) as viewer:
        panel, client = viewer.panel, Client(viewer.url)
        client.send_camera()
        client.set(panel.measure, True)
        client.image()
        client.set(panel.save_scale, True)
        wait_until(lambda: "two points in one frame" in capfd.readouterr().err)
        client.click(0.3, 0.5)
        client.click(0.7, 0.5)
        wait_until(lambda: viewer.measuring.measured is not None and viewer.measuring.measured.paths.shape[1] == 2)
        units = viewer.measuring.measured.curve("Distance")[0]
        client.set(panel.known_mm, 30.0)
        time.sleep(1.1)  # saving is limited to once a second
        client.set(panel.save_scale, True)
        wait_until(lambda: "Saved: known length in frame 0" in panel.scaled.content)
        client.socket.close()
    assert load_sequence(folder).scale.factor == pytest.approx(30 / units)
    again = open_viewable(folder, None)[0]
    assert again.can_scale and not again.relative, "it can be replaced"
    assert "known length in frame 0; lengths in mm err by" in status(again, ViewSettings(layer="frame"), 0).replace(
        "\\", ""
    )
    (folder / "sequence.json").write_text(json.dumps({"fx": 80, "depth_scale": 0.01}))
    assert not open_viewable(folder, None)[0].can_scale
