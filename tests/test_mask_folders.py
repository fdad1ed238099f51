"""Masks as other programs write them: each layout is written as that program does, and read back."""

import json

import cv2
import mask_layouts as by
import numpy as np
import pytest
from mask_layouts import FRAMES, HEIGHT, SIZE, WIDTH, jaw, shaft, tissue
from video_files import write_video

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data.images import read_tool_mask
from endoprior.data.mask_folders import open_mask_folder
from endoprior.data.mask_folders.parts import mask_of_coco, mask_of_runs, tool_labels
from endoprior.prepare import PrepareConfig, prepare
from endoprior.prepare.first_pass import source_facts

LAYOUTS = {
    by.sam2_palette: "SAM 2, palette images",
    by.sam2_light_background: "SAM 2, palette images",
    by.sam2_video: "SAM 2, palette images",
    by.sam2_objects: "SAM 2, a folder per object",
    by.sam2_video_objects: "SAM 2, a folder per object",
    by.sav: "SA-V annotations",
    by.cvat: "CVAT segmentation masks; tools: shaft, jaw; not tools: tissue",
    by.cvat_green_background: "CVAT segmentation masks",
    by.cvat_indices: "CVAT segmentation masks",
    by.cvat_xml: "CVAT for images; tools: shaft, jaw; not tools: tissue; shapes left out: 4 of box",
    by.label_studio: "Label Studio brush labels; tools: Needle-driver, Shaft; not tools: tissue; tasks are matched",
    by.label_studio_numpy: "Label Studio brush labels",
    by.label_studio_twins: "Label Studio brush labels",
    by.nerfstudio: "nerfstudio masks; tools: where a mask is 0",
    by.plain: "",
}


@pytest.mark.parametrize("write", LAYOUTS, ids=lambda write: write.__name__)
def test_every_layout_gives_the_same_masks(tmp_path, write):
    write(tmp_path / "given")
    found = open_mask_folder(tmp_path / "given")
    assert found.note.startswith(LAYOUTS[write]) and bool(found.note) == (write is not by.plain)
    assert found.tool_is_high == {by.nerfstudio: False, by.plain: None}.get(write, True)
    assert len(found.frames) == FRAMES
    for i, frame in enumerate(found.frames):
        want = shaft(i) | jaw(i) if i or write not in (by.sam2_objects, by.sam2_video_objects) else shaft(i)
        mask = frame.read(SIZE)
        mask = ~mask if found.tool_is_high is False else mask
        if write is by.cvat_xml:  # a polygon has no exact pixels
            assert (mask ^ want).sum() <= 2 * (10 + 17)
        else:
            assert (mask == want).all()
        if write is not by.plain or i:
            with pytest.raises(InputError, match=f"{WIDTH}x{HEIGHT}"):
                frame.read((WIDTH + 2, HEIGHT))


@pytest.mark.parametrize(
    ("write", "labels", "want"),
    [
        (by.sam2_palette, "2", [jaw]),
        (by.sam2_objects, "1", [shaft]),
        (by.sav, "1", [jaw]),
        (by.cvat, "jaw", [jaw]),
        (by.cvat, "Tissue, shaft", [tissue, shaft]),
        (by.cvat_xml, "shaft", [shaft]),
        (by.label_studio, "needle-driver", [jaw]),
    ],
)
def test_labels_can_be_chosen(tmp_path, write, labels, want):
    write(tmp_path / "given")
    frame = open_mask_folder(tmp_path / "given", labels).frames[1]
    wanted = np.any([part(1) for part in want], axis=0)
    if (write, labels) == (by.cvat, "Tissue, shaft"):
        wanted &= ~jaw(1)  # painted over
    assert (frame.read(SIZE) == wanted).all()


PARTS = {
    "SegmentationClass": by.cvat,
    "annotations.xml": by.cvat_xml,
    "sav_000001_manual.json": by.sav,
    "masks": by.nerfstudio,
    "masks_2": by.nerfstudio,
}


@pytest.mark.parametrize("inner", PARTS)
def test_a_part_of_a_layout_is_enough(tmp_path, inner):
    PARTS[inner](tmp_path / "given")
    size = SIZE if inner != "masks_2" else (WIDTH // 2, HEIGHT // 2)
    found, whole = (open_mask_folder(tmp_path / part) for part in (f"given/{inner}", "given"))
    assert found.note == whole.note and found.tool_is_high == whole.tool_is_high
    assert all((a.read(size) == b.read(size)).all() for a, b in zip(found.frames, whole.frames, strict=True))


def test_palette_images_of_grays_are_plain_masks(tmp_path):
    for i in range(FRAMES):
        by.palette_png(tmp_path / f"{i:05d}.png", shaft(i), [255, 255, 255, 0, 0, 0])
    found = open_mask_folder(tmp_path)
    assert found.note == "" and found.tool_is_high is None and (found.frames[1].read(SIZE) == ~shaft(1)).all()


def test_images_of_a_cvat_task_without_a_shape_have_empty_masks(tmp_path):
    folder = by.cvat(tmp_path / "given")
    (folder / "SegmentationClass" / "frame_000002.png").unlink()
    masks = [frame.read(SIZE) for frame in open_mask_folder(folder).frames]
    assert [bool(mask.any()) for mask in masks] == [True, True, False, True]


def test_frames_of_sav_are_numbered_by_the_video(tmp_path):
    by.sav(tmp_path)
    file = tmp_path / "sav_000001_manual.json"
    stored = json.loads(file.read_text()) | {"video_frame_count": 13.0}
    stored["masklet"][1][0] = None  # out of view
    file.write_text(json.dumps(stored))
    found = open_mask_folder(file)
    assert [frame.name for frame in found.frames] == ["0.json", "3.json", "6.json", "9.json"]
    assert (found.frames[1].read(SIZE) == jaw(1)).all() and "one frame in 3" in found.note


@pytest.mark.parametrize("facts", [{"video_frame_count": float("nan")}, {"masklet_id": 7}, {"masklet_id": [1]}])
def test_odd_facts_of_sav_are_left_out(tmp_path, facts):
    by.sav(tmp_path)
    file = tmp_path / "sav_000001_manual.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | facts))
    found = open_mask_folder(file)
    assert [frame.name for frame in found.frames] == [f"{i}.json" for i in range(FRAMES)]
    assert found.note == "SA-V annotations; tools: objects 0, 1"


@pytest.mark.parametrize(
    ("labels", "tools"),
    [
        (["shaft", "tissue"], ["shaft"]),
        (["Tool1", "tool2", "Background"], ["Tool1", "tool2"]),
        (["Instruments"], ["Instruments"]),
        (["blob"], ["blob"]),
        (["blob", "ignore"], ["blob"]),
        (["tissue forceps", "liver"], ["tissue forceps"]),
        (["needleDriver", "no tool"], ["needleDriver"]),
    ],
)
def test_labels_whose_names_tell(tmp_path, labels, tools):
    assert tool_labels(tmp_path, labels, "") == tools


@pytest.mark.parametrize("labels", [["red", "yellow"], ["shaft", "thing"], ["tissue"], ["tissue", "fat"]])
def test_labels_whose_names_do_not_tell_are_named(tmp_path, labels):
    with pytest.raises(InputError, match="labels whose names tell") as error:
        tool_labels(tmp_path, labels, "")
    assert ", ".join(labels) in str(error.value) and "`--mask-labels " in str(error.value)


def test_run_lengths():
    assert mask_of_runs([2, 3, 1, 1], 7).tolist() == [False, False, True, True, True, False, True]
    assert mask_of_runs([0, 6, 1], 7).tolist() == [True] * 6 + [False]
    rng = np.random.default_rng(0)
    for share in (0.02, 0.5, 0.9):
        mask = cv2.blur(rng.random((HEIGHT, WIDTH)), (9, 9)) > np.quantile(
            cv2.blur(rng.random((48, 64)), (9, 9)), share
        )
        runs = by.runs_of(mask.T.ravel())
        assert (mask_of_coco(by.packed(runs), (HEIGHT, WIDTH)) == mask).all()
        assert (mask_of_coco(runs, (HEIGHT, WIDTH)) == mask).all()
    for wrong in ("o", "\x01", by.packed([2, 3]), [1 << 62, 1 << 62, 1 << 62, (1 << 62) + 16], [-1, 17]):
        with pytest.raises(ValueError):
            mask_of_coco(wrong, (4, 4))


def damaged_rle(folder):
    by.cvat_xml(folder)
    file = folder / "annotations.xml"
    file.write_text(file.read_text().replace('rle="', 'rle="7, '))


def edited(write, file, old, new):
    def damage(folder):
        write(folder)
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new))

    return damage


def two_videos(folder):
    by.sam2_palette(folder / "a")
    by.sam2_palette(folder / "b")


def foreign_color(folder):
    by.cvat(folder)
    by.gray_png(folder / "SegmentationClass" / "frame_000000.png", np.full((HEIGHT, WIDTH, 3), (3, 2, 1)))


def nothing(folder):
    folder.mkdir()


BAD = {
    "run lengths of": damaged_rle,
    "a box outside": edited(by.cvat_xml, "annotations.xml", 'left="5"', 'left="60"'),
    "the attribute 'top', got none": edited(by.cvat_xml, "annotations.xml", 'top="0"', ""),
    "points that are not": edited(by.cvat_xml, "annotations.xml", "3.00,20.00;", "3.00;"),
    "a document type": edited(by.cvat_xml, "annotations.xml", "<annotations>", "<!DOCTYPE a><annotations>"),
    "CVAT's XML, got no element": edited(by.cvat_xml, "annotations.xml", "</annotations>", ""),
    "tracks of a video": edited(by.cvat_xml, "annotations.xml", "image", "track"),
    "label:red,green,blue": edited(by.cvat, "labelmap.txt", "61,61,245", "61"),
    "label:red,green,blue:parts:actions, got shaft:999": edited(by.cvat, "labelmap.txt", "61,61,245", "999,61,245"),
    "only colors of labelmap.txt, got 1,2,3": foreign_color,
    "run lengths that fill": edited(by.sav, "sav_000001_manual.json", '"counts": "', '"counts": "3'),
    "a list of objects per frame": edited(by.sav, "sav_000001_manual.json", '"masklet": [[', '"masklet": [3, ['),
    "the folders a, b": two_videos,
    "got none": nothing,
}


@pytest.mark.parametrize("says", BAD)
def test_damage_is_one_line_that_names_the_file(tmp_path, says):
    BAD[says](tmp_path / "given")
    with pytest.raises(InputError) as error:
        for frame in open_mask_folder(tmp_path / "given").frames:
            frame.read(SIZE)
    text = str(error.value)
    assert says in text and "\n" not in text and str(tmp_path) in text and "Fix: " in text


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (by.plain, r"labels of \S+ \(0, 255\), got shaft"),
        (by.nerfstudio, "masks with labels, got masks of one kind"),
    ],
)
def test_labels_of_masks_without_labels_are_an_error(tmp_path, write, says):
    write(tmp_path / "given")
    with pytest.raises(InputError, match=f"--mask-labels: expected {says}"):
        open_mask_folder(tmp_path / "given", "shaft")
    by.cvat(tmp_path / "cvat")
    with pytest.raises(InputError, match=r"--mask-labels: .*\(shaft, jaw, tissue\), got grasper"):
        open_mask_folder(tmp_path / "cvat", "grasper")


def video(folder):
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(90, 200, (6, 8, 3), np.uint8), SIZE)
    images = [np.where((shaft(i) | jaw(i))[..., None], 120, wall).astype(np.uint8) for i in range(FRAMES)]
    return write_video(folder / "v.mkv", images)


OPTIONS = {"depth": "none", "poses": "still", "border": "keep"}


@pytest.mark.parametrize(("write", "file"), [(by.nerfstudio, "transforms.json"), (by.cvat_xml, "annotations.xml")])
def test_names_of_images_that_were_written_on_windows(write, file, tmp_path):
    write(tmp_path)
    frames = open_mask_folder(tmp_path).frames
    text = (tmp_path / file).read_text()
    changed = (
        json.dumps(json.loads(text)).replace("/", r"\\")
        if write is by.nerfstudio
        else text.replace('name="', 'name="a\\')
    )
    assert changed != text
    (tmp_path / file).write_text(changed)
    found = open_mask_folder(tmp_path).frames
    assert [each.name for each in found] == [each.name for each in frames]
    assert all((a.read(SIZE) == b.read(SIZE)).all() for a, b in zip(found, frames, strict=True))


@pytest.mark.parametrize("write", [by.sam2_objects, by.cvat, by.label_studio, by.nerfstudio, by.cvat_xml])
def test_prepare_reads_them_and_says_what_it_recognized(tmp_path, write):
    write(tmp_path / "given")
    done = prepare(video(tmp_path), tmp_path / "out", PrepareConfig(masks=str(tmp_path / "given"), **OPTIONS))
    assert any(note.startswith(f"masks: {LAYOUTS[write]}") for note in done.notes)
    for i, file in enumerate(sorted((done.out / "masks").glob("*.png"))):
        want = shaft(i) if write is by.sam2_objects and i == 0 else shaft(i) | jaw(i)
        assert (read_tool_mask(file) ^ want).sum() <= (2 * 27 if write is by.cvat_xml else 0)


def test_the_polarity_of_a_layout_can_be_overridden(tmp_path):
    by.nerfstudio(tmp_path / "given")
    cfg = PrepareConfig(masks=str(tmp_path / "given"), mask_tool_value="high", **OPTIONS)
    done = prepare(video(tmp_path), tmp_path / "out", cfg)
    assert (read_tool_mask(done.out / "masks" / "000001.png") == ~(shaft(1) | jaw(1))).all()


def test_tasks_of_label_studio_must_be_as_many_as_frames(tmp_path, capsys):
    by.label_studio(tmp_path / "given", first=0)
    for file in (tmp_path / "given").glob("task-3-*"):
        file.unlink()
    words = ["prepare", str(video(tmp_path)), str(tmp_path / "out"), "--depth", "none", "--masks"]
    assert main([*words, str(tmp_path / "given")]) == 2
    error = capsys.readouterr().err
    assert "expected masks of as many tasks as frames, got 3 tasks for 4 frames" in error and error.count("\n") == 1
    assert main([*words, "none", "--mask-labels", "a"]) == 2
    assert "--mask-labels: expected a folder with --masks, got none" in capsys.readouterr().err


def test_a_changed_mask_in_an_inner_folder_changes_the_identity(tmp_path):
    by.sam2_objects(tmp_path / "given")
    before = source_facts(tmp_path / "given")
    by.palette_png(tmp_path / "given" / "001" / "00002.png", jaw(0))
    assert source_facts(tmp_path / "given") != before
