"""A folder of frames with their masks, as people have it: `run` and `prepare` take it, other commands say so."""

from __future__ import annotations

import json
import re
import shlex
import shutil

import cv2
import numpy as np
import pytest
from command_modules import parsed

from endoprior.cli import main
from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.pipeline import Job, SequenceJob
from endoprior.prepare import PrepareConfig, prepare

WIDTH, HEIGHT, FRAMES = 160, 128, 10
QUICK = {"depth": "none", "poses": "still"}


def frames():
    """Red tissue with a gray rod that comes in from the right: (image, rod) of each frame."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((HEIGHT, WIDTH)).astype(np.float32), (0, 0), 3)
    for i in range(FRAMES):
        shade = np.roll(noise / noise.std(), i, 1)
        rod = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.line(rod, (WIDTH + 20, 100), (95 + i, 60), 255, 14)
        tissue = np.stack([60 + 18 * shade, 70 + 20 * shade, 160 + 25 * shade], -1)
        yield np.clip(np.where(rod[..., None] > 0, 130.0, tissue), 0, 255).astype(np.uint8), rod > 0


KINDS = {
    "255": lambda rod: 255 * rod,
    "1": lambda rod: 1 * rod,
    "0 is tool": lambda rod: 255 * ~rod,
    "labels": lambda rod: np.where(rod, np.where(np.arange(WIDTH) > 120, 2, 5), 0),
    "255 is a rim": lambda rod: rod + 255 * ((cv2.dilate(rod.astype(np.uint8), np.ones((5, 5))) > 0) & ~rod),
}


@pytest.fixture
def mine(tmp_path):
    """Writes `mine/`, with images and masks in folders of these names."""

    def write(images="images", masks="masks", kind="255", ending=""):
        for index, (image, rod) in enumerate(frames()):
            for name, pixels, end in ((images, image, ""), (masks, KINDS[kind](rod).astype(np.uint8), ending)):
                if name is not None:
                    (tmp_path / "mine" / name).mkdir(parents=True, exist_ok=True)
                    assert cv2.imwrite(str(tmp_path / "mine" / name / f"{index:04d}{end}.png"), pixels)
        return tmp_path / "mine"

    return write


def overlap(data):
    """How well the masks of a sequence are the rods, IoU."""
    sequence, rods = load_sequence(data), np.stack([rod for _, rod in frames()])
    tools = np.stack([~sequence.frame(i).tissue_mask for i in range(len(sequence))])
    return (tools & rods).sum() / (tools | rods).sum()


def line(capsys, *words):
    """The error of a command, one line."""
    assert main([str(word) for word in words]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    return text


@pytest.mark.parametrize("kind", KINDS)
def test_masks_beside_images_are_taken_whatever_their_convention(mine, tmp_path, kind):
    done = prepare(mine(kind=kind), tmp_path / "data", PrepareConfig(**QUICK))
    assert done.num_frames == FRAMES and overlap(done.out) > (0.6 if kind == "255 is a rim" else 0.95)
    said = f"masks: those in {tmp_path / 'mine/masks'} are used. For none: `--masks none`"
    assert any(said in note for note in done.notes)


@pytest.mark.parametrize(("images", "masks"), [("frames", "labels"), ("rgb", "tool_masks"), (".", "masks")])
def test_folders_are_told_by_the_words_of_their_names(mine, tmp_path, images, masks):
    done = prepare(mine(images, masks), tmp_path / "data", PrepareConfig(**QUICK))
    assert done.num_frames == FRAMES and overlap(done.out) > 0.95


def test_masks_that_are_asked_for_win(mine, tmp_path):
    done = prepare(mine(), tmp_path / "data", PrepareConfig(masks="none", **QUICK))
    assert load_sequence(done.out).frame(3).tissue_mask.mean() > 0.99


def test_labels_that_may_be_tissue_are_asked_for(mine, tmp_path, capsys):
    folder = mine()
    for file in sorted((folder / "masks").iterdir()):
        rod = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) > 0
        cv2.imwrite(str(file), np.where(rod, 7, np.where(np.arange(WIDTH) > 40, 3, 0)).astype(np.uint8))
    text = line(capsys, "prepare", folder, tmp_path / "data", "--depth", "none")
    assert "got the labels 0, 3, 7" in text and "Fix: Name those of tools, such as `--mask-labels 7`." in text
    assert not (tmp_path / "data").exists()
    options = ["--depth", "none", "--poses", "still", "--mask-labels", "7"]
    assert main(["prepare", str(folder), str(tmp_path / "data"), *options]) == 0
    assert overlap(tmp_path / "data") > 0.95


def test_the_frame_rate_is_that_of_the_folder_or_is_said_to_be_assumed(mine, tmp_path, capsys):
    folder = mine()

    def job():
        return parsed("run", str(folder), str(tmp_path / "out"), "--preview").job(print)

    assert isinstance(job(), Job) and job().part.frames_per_second == 25 and job().part.num_frames == FRAMES
    note = f"the frame rate of {folder / 'images'} is unknown, 25/s assumed: --folder-rate sets it"
    assert note in prepare(folder, tmp_path / "data", PrepareConfig(**QUICK)).notes
    told = prepare(folder, tmp_path / "told", PrepareConfig(folder_rate=10, **QUICK))
    assert note not in told.notes and load_sequence(told.out).frames_per_second == 10
    (folder / "sequence.json").write_text(json.dumps({"frames_per_second": 12.5}))
    assert job().part.frames_per_second == 12.5
    written = prepare(folder, tmp_path / "written", PrepareConfig(**QUICK))
    assert note not in written.notes and load_sequence(written.out).frames_per_second == 12.5
    assert "--folder-rate: folder_rate must be in" in line(
        capsys, "prepare", folder, tmp_path / "x", "--folder-rate", "0"
    )


def test_the_lens_of_the_folder_is_used(mine, tmp_path):
    folder = mine()
    (folder / "intrinsics.txt").write_text("140 0 80\n0 140 64\n0 0 1\n")
    done = prepare(folder, tmp_path / "data", PrepareConfig(**QUICK))
    assert load_sequence(done.out).camera(0).fx == pytest.approx(140)
    assert f"calibration: that of {folder / 'intrinsics.txt'}" in done.notes


@pytest.mark.parametrize("names", [("images", "masks"), ("frames", "labels"), ("images", None)])
def test_every_command_leads_to_run_and_prepare(mine, tmp_path, capsys, names):
    folder = mine(*names)
    out, ways = tmp_path / "out", rf"`endoprior prepare {folder} \S+`, then .*; every step: `(endoprior run .*?)`\."
    run = re.search(ways, line(capsys, "train", folder, out))[1]
    assert type(parsed(*shlex.split(run)[1:]).job(print)) is Job
    assert f"expected a run folder, got a folder of images. Fix: `endoprior run {folder} " in line(
        capsys, "eval", folder
    )
    if names[0] == "images":
        assert main(["check", str(folder)]) == 0
        said = capsys.readouterr().out
        assert re.search(f"error: no-depth-frames: .*Fix: {ways[:-2]}", said) and "check the files" not in said
    else:
        assert re.search(ways, line(capsys, "check", folder))
    assert main(["scan", str(folder), str(tmp_path / "scan.json")]) == 0


def test_a_list_of_a_batch_may_name_such_a_folder(mine, tmp_path):
    from endoprior.cli.batch import entries_of

    (tmp_path / "list.txt").write_text(f"a = {mine()} --preview\n")
    (entry,) = entries_of(tmp_path / "list.txt", tmp_path / "out", print)
    assert isinstance(entry.job, Job) and entry.job.is_preview


def test_a_sequence_with_depth_is_not_prepared_again(make_tiny_sequence, tmp_path, capsys):
    data = make_tiny_sequence("data")
    text = line(capsys, "prepare", data, tmp_path / "again")
    assert f"got a sequence folder. Fix: `endoprior train {data} RUN`; " in text
    again = shlex.split(re.search(r"again: `(.*?)`\.", text)[1])
    assert again == ["endoprior", "prepare", f"{data}/images", "OUT", "--masks", f"{data}/masks"]
    assert type(parsed("run", str(data), str(tmp_path / "out")).job(print)) is SequenceJob
    shutil.rmtree(data / "depth")
    for name in ("poses_bounds.npy", "sequence.json"):
        (data / name).unlink()
    assert type(parsed("run", str(data), str(tmp_path / "out")).job(print)) is Job


def test_folders_that_cannot_be_told_apart_are_named(mine, tmp_path, capsys):
    folder = mine("camera", "tools_mask")
    shutil.copytree(folder / "tools_mask", folder / "tissue_mask")
    text = line(capsys, "prepare", folder, tmp_path / "data")
    assert f"{folder}: expected one folder of masks, got tissue_mask, tools_mask." in text
    named = ["--masks", str(folder / "tools_mask"), "--depth", "none", "--poses", "still"]
    assert main(["prepare", str(folder), str(tmp_path / "data"), *named]) == 0
    capsys.readouterr()
    shutil.copytree(folder / "camera", folder / "other")
    text = line(capsys, "prepare", folder, tmp_path / "more")
    assert "got images in camera, other. Fix: Pass one, such as " in text
    (tmp_path / "empty").mkdir()
    text = line(capsys, "run", tmp_path / "empty", tmp_path / "out")
    assert "got none. Fix: Pass the folder that holds images, or a video." in text
    with pytest.raises(InputError, match="got no such file"):
        prepare(tmp_path / "absent", tmp_path / "x")
