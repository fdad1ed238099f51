"""From video files to sequence folders: a stereo phantom in every layout, one camera, bad input, interruption."""

import json
import shutil

import cv2
import numpy as np
import pytest
from video_files import write_video

from endoprior.core.checks import InputError
from endoprior.data import load_sequence
from endoprior.phantom import PhantomConfig, write_phantom
from endoprior.prepare import PrepareConfig, prepare

FRAMES, WIDTH, HEIGHT = 5, 256, 192


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stereo") / "phantom"
    write_phantom(folder, PhantomConfig(frames=FRAMES, width=WIDTH, height=HEIGHT, stereo=True, principal_x=120.0))
    return folder


def cameras(phantom):
    def read(name):
        return [cv2.imread(str(file))[..., ::-1] for file in sorted((phantom / name).glob("*.png"))]

    return read("images"), read("right")


def options(phantom, **changed):
    return PrepareConfig(**({"calibration": phantom / "calibration.json", "masks": str(phantom / "masks")} | changed))


def pairs(done, phantom):
    """The frames of a prepared folder, each with that of the phantom."""
    return zip(load_sequence(done.out).frames("video"), load_sequence(phantom).frames("video"), strict=True)


def depth_error(folder, phantom):
    """Median |depth - truth| on tissue, mm, and the share of tissue that has a depth."""
    errors, shares = [], []
    for frame in load_sequence(folder).frames("video"):
        truth = np.load(phantom / f"truth/depth/{frame.index:06d}.npy")
        tissue = cv2.erode(frame.tissue_mask.astype(np.uint8), np.ones((5, 5))) > 0
        errors.append(np.median(np.abs(frame.depth - truth)[tissue & frame.depth_valid]))
        shares.append(frame.depth_valid[tissue].mean())
    return float(np.median(errors)), float(np.median(shares))


def interlaced(left, right):
    frame = np.empty_like(left)
    frame[::2], frame[1::2] = left[::2], right[1::2]
    return frame


LAYOUTS = {
    "top-bottom": lambda left, right: np.vstack([left, right]),
    "side-by-side": lambda left, right: np.hstack([left, right]),
    "interlaced": interlaced,
}


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("top-bottom", "interlaced")]


@pytest.mark.parametrize("layout", ["side-by-side", *SLOW])
def test_a_stereo_video_becomes_a_sequence(tmp_path, phantom, layout):
    frames = [LAYOUTS[layout](*pair) for pair in zip(*cameras(phantom), strict=True)]
    video = write_video(tmp_path / "v.mp4", frames, rate=15)
    done = prepare(video, tmp_path / "out", options(phantom, keep_right=True))
    sequence = load_sequence(done.out)
    assert (done.num_frames, done.size, sequence.frames_per_second) == (FRAMES, (WIDTH, HEIGHT), 15)
    camera, true = sequence.camera(0), load_sequence(phantom).camera(0)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (true.fx, true.fy, true.cx, true.cy)
    error, share = depth_error(done.out, phantom)
    assert error < (1.0 if layout != "interlaced" else 2.0) and share > 0.8  # half of the rows are made up
    for frame, original in pairs(done, phantom):
        assert np.array_equal(frame.tissue_mask, original.tissue_mask)
        if layout != "interlaced":
            assert np.abs(frame.rgb_u8.astype(int) - original.rgb_u8).mean() < 2  # H.264
    assert len(list((done.out / "right").glob("*.png"))) == FRAMES
    assert sequence.right_eye.baseline_mm == pytest.approx(load_sequence(phantom).right_eye.baseline_mm)
    assert not sequence.depth_is_relative and "stereo" in sequence.sources["depth"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "v.mp4"]


def test_two_image_folders_and_a_time_range(tmp_path, phantom):
    cfg = options(phantom, right=phantom / "right", start=1 / 25, end=4 / 25, border="keep")
    done = prepare(phantom / "images", tmp_path / "out", cfg)
    assert done.num_frames == 3
    for mine, original in zip(load_sequence(done.out).frames("video"), (1, 2, 3), strict=True):
        true = load_sequence(phantom).frame(original)
        assert np.array_equal(mine.rgb_u8, true.rgb_u8) and np.array_equal(mine.tissue_mask, true.tissue_mask)


def test_monocular_video_without_options(tmp_path, phantom):
    done = prepare(write_video(tmp_path / "v.mp4", cameras(phantom)[0]), tmp_path / "out")
    sequence = load_sequence(done.out)
    assert sequence.depth_is_relative and sequence.frame(0).depth_valid.mean() > 0.9
    tissue = [frame.depth[frame.tissue_mask] for frame in sequence.frames("video")]
    assert np.median(np.concatenate(tissue)) == pytest.approx(70, rel=0.1)
    text = " ".join(done.notes)
    assert "no calibration" in text and "relative (shading)" in text and "static" in text and "70 mm" not in text
    assert sequence.validate() is not None


@pytest.mark.parametrize("kind", ["npy", "png", "tiff"])
def test_depth_files_with_a_unit(tmp_path, phantom, kind):
    (tmp_path / "depth").mkdir()
    for index, frame in enumerate(load_sequence(phantom).frames("video")):
        meters = (frame.depth / 1000).astype(np.float32)
        file = tmp_path / f"depth/{index:03d}.{kind}"
        if kind == "npy":
            np.save(file, np.where(frame.depth_valid, meters, np.nan))
        else:
            cv2.imwrite(str(file), np.round(frame.depth * 100).astype(np.uint16) if kind == "png" else meters)
    given = {"depth": str(tmp_path / "depth"), "layout": "mono"}
    cfg = options(phantom, **given, depth_unit_mm=0.01 if kind == "png" else 1000.0)
    done = prepare(phantom / "images", tmp_path / "out", cfg)
    for mine, true in pairs(done, phantom):
        assert np.abs(mine.depth - true.depth).max() < 0.02 and np.array_equal(mine.depth_valid, true.depth_valid)
    with pytest.raises(InputError, match="--depth-unit-mm: expected mm per unit of the files in"):
        prepare(phantom / "images", tmp_path / "no", options(phantom, **given))


def test_depth_in_another_unit_than_declared(tmp_path, phantom):
    (tmp_path / "depth").mkdir()
    for index, frame in enumerate(load_sequence(phantom).frames("video")):
        np.save(tmp_path / f"depth/{index}.npy", frame.depth / 1000)
    before = options(phantom, depth=str(tmp_path / "depth"), depth_unit_mm=1.0, layout="mono")
    with pytest.raises(InputError, match=r"expected tissue 20 to 250 mm away.*multiply --depth-unit-mm by 1000"):
        prepare(phantom / "images", tmp_path / "out", before)
    for index, frame in enumerate(load_sequence(phantom).frames("video")):
        cv2.imwrite(str(tmp_path / f"depth/{index}.png"), frame.depth.astype(np.uint8))
        (tmp_path / f"depth/{index}.npy").unlink()
    done = prepare(phantom / "images", tmp_path / "out", before)
    assert any("8-bit files are too coarse" in remark for remark in done.notes)


def test_relative_disparity_of_a_network(tmp_path, phantom):
    (tmp_path / "disparity").mkdir()
    for index in range(FRAMES):
        true = np.load(phantom / f"truth/depth/{index:06d}.npy")
        np.save(tmp_path / f"disparity/{index}.npy", (3000 / true - 7).astype(np.float32))
    cfg = options(phantom, depth=str(tmp_path / "disparity"), depth_relative="disparity", layout="mono")
    done = prepare(phantom / "images", tmp_path / "out", cfg)
    sequence = load_sequence(done.out)
    frame, true = sequence.frame(0), np.load(phantom / "truth/depth/000000.npy")
    assert sequence.depth_is_relative
    assert np.corrcoef(1 / frame.depth[frame.tissue_mask], 1 / true[frame.tissue_mask])[0, 1] > 0.99


def test_source_identity_includes_the_files_of_a_folder(tmp_path, phantom, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "depth-anything-maps"
    folder.mkdir()
    for index in range(FRAMES):
        np.save(folder / f"{index}.npy", np.load(phantom / f"truth/depth/{index:06d}.npy"))
    cfg = options(phantom, depth="depth-anything-maps", depth_unit_mm=1.0, layout="mono")
    done = prepare(phantom / "images", tmp_path / "out", cfg)
    assert not load_sequence(done.out).depth_is_relative
    assert np.median(np.abs(load_sequence(done.out).frame(1).depth - np.load(folder / "1.npy"))) < 0.01


def test_inverted_masks_are_corrected(tmp_path, phantom):
    (tmp_path / "masks").mkdir()
    for file in (phantom / "masks").glob("*.png"):
        cv2.imwrite(str(tmp_path / "masks" / file.name), 255 - cv2.imread(str(file), 0))
    cfg = options(phantom, masks=str(tmp_path / "masks"), layout="mono")
    done = prepare(phantom / "images", tmp_path / "out", cfg)
    assert any("low values mark tools" in remark for remark in done.notes)
    for mine, true in pairs(done, phantom):
        assert np.array_equal(mine.tissue_mask, true.tissue_mask)


def test_masks_of_all_frames_fit_a_folder_that_lacks_some(tmp_path, phantom):
    shutil.copytree(phantom / "images", tmp_path / "images")
    (tmp_path / "images/000001.png").unlink()
    done = prepare(tmp_path / "images", tmp_path / "out", options(phantom, layout="mono", depth="none"))
    written = [cv2.imread(str(file), 0) for file in sorted((done.out / "masks").glob("*.png"))]
    given = [cv2.imread(str(phantom / f"masks/{number:06d}.png"), 0) for number in (0, 2, 3, 4)]
    assert all(np.array_equal(a, b) for a, b in zip(written, given, strict=True))


def test_labels_are_blanked_and_only_the_record_names_the_video(tmp_path, phantom):
    cfg = options(phantom, layout="mono", blank=("10,20,50,15",))
    done = prepare(write_video(tmp_path / "SMITH_John.mkv", cameras(phantom)[0]), tmp_path / "out", cfg)
    frame = load_sequence(done.out).frame(1)
    assert not frame.rgb_u8[20:35, 10:60].any() and not frame.tissue_mask[20:35, 10:60].any()
    files = [file for file in done.out.rglob("*") if file.is_file()]
    assert not any("SMITH" in file.name for file in files)
    assert [file.name for file in files if b"SMITH" in file.read_bytes()] == ["prepare.json"], "as docs/prepare.md says"


@pytest.mark.slow
def test_frames_outside_the_body_can_be_dropped(tmp_path, phantom):
    images = cameras(phantom)[0]
    images.insert(2, np.full_like(images[0], (90, 140, 160)))
    video = write_video(tmp_path / "v.mkv", images)
    kept = prepare(video, tmp_path / "kept", PrepareConfig(layout="mono"))
    assert json.loads((kept.out / "sequence.json").read_text())["unexplained_frames"] == [2]
    assert any("no camera pose" in note and "frame 2;" in note for note in kept.notes)
    dropped = prepare(video, tmp_path / "dropped", PrepareConfig(layout="mono", drop_out_of_body=True))
    assert dropped.num_frames == FRAMES


@pytest.mark.slow
def test_an_interrupted_run_resumes_with_identical_files(tmp_path, phantom):
    cfg = options(phantom, right=phantom / "right")
    want = prepare(phantom / "images", tmp_path / "want", cfg).out

    def stop(what, done, total):
        if what == "writing frames" and done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(phantom / "images", tmp_path / "out", cfg, stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".out.endoprior.preparing", "want"]
    written = []
    done = prepare(phantom / "images", tmp_path / "out", cfg, lambda what, done, total: written.append((what, done)))
    assert ("writing frames", 3) in written and ("writing frames", 2) not in written
    names = sorted(path.relative_to(want) for path in want.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(done.out) for path in done.out.rglob("*") if path.is_file())
    assert all((want / name).read_bytes() == (done.out / name).read_bytes() for name in names)


def empty(folder):
    (folder / "v.mp4").touch()
    return folder / "v.mp4"


def cut_short(folder, phantom):
    video = write_video(folder / "v.mp4", [np.hstack(pair) for pair in zip(*cameras(phantom), strict=True)] * 8)
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    return video


def smaller_masks(folder, phantom):
    (folder / "masks").mkdir()
    for file in (phantom / "masks").glob("*.png"):
        cv2.imwrite(str(folder / "masks" / file.name), cv2.imread(str(file), 0)[::2, ::2])
    return folder / "masks"


def without(folder, phantom, key):
    content = json.loads((phantom / "calibration.json").read_text())
    del content[key]
    (folder / "c.json").write_text(json.dumps(content))
    return folder / "c.json"


MONO = {"layout": "mono"}
BAD = {
    "missing calibration key": lambda d, p: ({"right": p / "right", "calibration": without(d, p, "R")}, "no R"),
    "second camera missing": lambda d, p: ({"layout": "two-files"}, "--right"),
    "a second file and two cameras in each frame": lambda d, p: (
        {"right": p / "right", "layout": "side-by-side"}, "--layout: expected auto or two-files with --right",
    ),
    "sgbm with one camera": lambda d, p: (MONO | {"depth": "sgbm"}, "expected two cameras"),
    "mask of another size": lambda d, p: (MONO | {"masks": str(smaller_masks(d, p))}, "px like the images"),
    "no mask folder": lambda d, p: (MONO | {"masks": "nowhere"}, "a folder of masks"),
    "no depth folder": lambda d, p: (MONO | {"depth": "nowhere"}, "a folder of depth"),
    "too many frames": lambda d, p: (MONO | {"max_frames": 3}, "at most 3 frames"),
    "nothing selected": lambda d, p: (MONO | {"start": 9.0}, "at least 2 frames"),
    "relative what": lambda d, p: (MONO | {"depth_relative": "depth"}, "a folder with --depth"),
    "no poses": lambda d, p: (MONO | {"poses": "nowhere.npy"}, "camera poses"),
    "blank outside": lambda d, p: (
        MONO | {"blank": ("0,0,9,9", "250,0,9,9")}, "--blank: expected a rectangle within 256x192 px, got 250,0,9,9",
    ),
    "crop outside": lambda d, p: (MONO | {"crop": "0,0,999,9"}, "--crop"),
    "calibration of another camera": lambda d, p: ({"layout": "side-by-side"}, "the same aspect ratio"),
    "swapped cameras": lambda d, p: ({"right": p / "images"}, "--swap-eyes", p / "right"),
    "zero-length video": lambda d, p: ({}, "an empty file", empty(d)),
    "truncated video": lambda d, p: ({"layout": "side-by-side"}, "--end", cut_short(d, p)),
    "no such video": lambda d, p: ({}, "no such file", d / "no.mp4"),
}  # fmt: skip
"""Options, what is said, and the video, if it is not the images of the phantom."""


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_gives_one_line_and_leaves_nothing(tmp_path, phantom, kind):
    changed, says, *video = BAD[kind](tmp_path, phantom)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError) as error:
        prepare(*video or [phantom / "images"], tmp_path / "out", options(phantom, **changed))
    assert says in str(error.value) and "\n" not in str(error.value)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_moving_monocular_camera(tmp_path):
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.random((500, 700, 3), np.float32), (0, 0), 2)
    wall = (60 + 150 * (noise - noise.min()) / np.ptp(noise) * np.array([1, 0.5, 0.45])).astype(np.uint8)
    images = [np.ascontiguousarray(wall[100 + 2 * i : 292 + 2 * i, 50 + 6 * i : 306 + 6 * i]) for i in range(16)]
    done = prepare(write_video(tmp_path / "v.mkv", images), tmp_path / "out", PrepareConfig(masks="none"))
    sequence = load_sequence(done.out)
    centers = np.array([sequence.camera(i).center for i in range(16)])
    assert any("the camera moves" in remark for remark in done.notes)
    # 6 px a frame at a working distance of 70 mm.
    step = 70 / sequence.camera(0).fx * np.array([6, 2])
    assert np.allclose(np.diff(centers[:, :2], axis=0).mean(0), step, rtol=0.25)
    still = prepare(tmp_path / "v.mkv", tmp_path / "still", PrepareConfig(masks="none", poses="still"))
    assert np.array_equal(load_sequence(still.out).camera(9).world_to_camera, np.eye(4))
