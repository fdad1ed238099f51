"""Folders of nerfstudio and COLMAP: lenses, axes of poses, masks, and points that land on themselves."""

from __future__ import annotations

import json
import shutil
import struct

import cv2
import numpy as np
import pytest
from known_surface import color_change, of_rays, off_the_plane, pose, seen, turned
from reader_checks import assert_damage_is_rejected, assert_rejected, edit_json, remark_with
from scipy.spatial.transform import Rotation
from sequence_edits import write

from endoprior.check.facts import measure
from endoprior.check.findings import find
from endoprior.cli import main
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.prepare.camera_path.pose_file import read_model_poses

SIZE, FRAMES = (96, 80), 11
MATRIX = np.array([[100.0, 0, 45.5], [0, 104, 42.25], [0, 0, 1]])
"""Pixel centers are halves, as in COLMAP and nerfstudio."""
POSES = [pose(turned(0.8 * i, -1.0 * i, 2.0 * i), (1.5 * i, -1.2 * i, 0.8 * i)) for i in range(FRAMES)]
SCALE = 0.02
"""mm to units of the reconstruction."""
BENT = {"k1": -0.3, "k2": 0.1, "p1": 0.002, "p2": -0.003}
FISHEYE = {"k1": -0.05, "k2": 0.01, "k3": 0.0, "k4": 0.0}


def through(lens):
    """Maps that take pinhole images of `MATRIX` to images of a lens."""
    at = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float64) for n in SIZE)), -1).reshape(-1, 1, 2)
    k = MATRIX - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    if lens is FISHEYE:
        flat = cv2.fisheye.undistortPoints(at, k, np.array([*lens.values()]))
    else:
        flat = cv2.undistortPoints(at, k, np.array([*lens.values()]), criteria=(3, 100, 1e-12))
    flat = flat[:, 0] * (k[0, 0], k[1, 1]) + k[:2, 2]
    return flat.reshape(SIZE[1], SIZE[0], 2)


def write_views(folder, lens=None, depth_scale=SCALE):
    """Images and depth of the plane; depth in units of the poses, `.npy`."""
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    for i, to_world in enumerate(POSES):
        if lens is None:
            color, depth = seen(MATRIX, to_world, SIZE)
        else:
            at = through(lens)
            rays = np.concatenate([at + 0.5, np.ones((*at.shape[:2], 1))], -1) @ np.linalg.inv(MATRIX).T
            color, depth = of_rays(rays, to_world)
        write(folder / f"images/frame_{i:05d}.png", color[..., ::-1])
        np.save(folder / f"depth/frame_{i:05d}.npy", (depth * depth_scale).astype(np.float32))
    return folder


@pytest.fixture
def nerfstudio(tmp_path):
    return write_nerfstudio(tmp_path / "scene")


def write_nerfstudio(folder, lens=None, **changes):
    write_views(folder, lens)
    to_opengl = np.diag([1.0, -1, -1, 1])
    frames = []
    for i in reversed(range(FRAMES)):  # the order of the file says nothing
        matrix = POSES[i] @ to_opengl
        matrix[:3, 3] *= SCALE
        frames.append({"file_path": f"images/frame_{i:05d}.png", "transform_matrix": matrix.tolist()})
    stored = {"fl_x": 100.0, "fl_y": 104.0, "cx": 45.5, "cy": 42.25, "w": 96, "h": 80, "frames": frames}
    if lens is not None:
        stored |= lens | {"camera_model": "OPENCV_FISHEYE" if lens is FISHEYE else "OPENCV"}
    (folder / "transforms.json").write_text(json.dumps(stored | changes))
    return folder


def write_colmap(folder, kind, place="sparse/0", lens=None):
    write_views(folder, lens)
    model, values = ("PINHOLE", []) if lens is None else ("OPENCV", [*lens.values()])
    values = [100.0, 104.0, 45.5, 42.25, *values]
    rows = []
    for i, to_world in enumerate(POSES):
        matrix = np.linalg.inv(to_world)
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        rows.append((FRAMES - i, (w, x, y, z, *(SCALE * matrix[:3, 3])), f"frame_{i:05d}.png"))
    out = folder / place
    out.mkdir(parents=True)
    if kind == "text":
        words = " ".join(map(repr, values))
        (out / "cameras.txt").write_text(f"# Camera list\n# Number of cameras: 1\n3 {model} 96 80 {words}\n")
        lines = []
        for number, numbers, name in rows:
            lines += [f"{number} {' '.join(repr(float(v)) for v in numbers)} 3 {name}", "10.5 20.5 -1 30.5 8.25 7"]
        lines[3] = ""  # an image without points
        (out / "images.txt").write_text("# Image list\n" + "\n".join(lines) + "\n")
    else:
        number = {"PINHOLE": 1, "OPENCV": 4}[model]
        (out / "cameras.bin").write_bytes(struct.pack(f"<QiiQQ{len(values)}d", 1, 3, number, 96, 80, *values))
        data = struct.pack("<Q", len(rows))
        for number, numbers, name in rows:
            data += struct.pack("<i7di", number, *numbers, 3) + name.encode() + b"\0"
            data += struct.pack("<Qddqddq", 2, 10.5, 20.5, -1, 30.5, 8.25, 7)
        (out / "images.bin").write_bytes(data)
    return folder


def assert_lands(folder, most_mm=0.02):
    """Points of every frame lie on the plane, and where they land in another frame their color is the same."""
    seq = load_sequence(folder)
    assert len(seq) == FRAMES and seq.depth_is_relative
    for camera in (seq.camera(i) for i in range(FRAMES)):
        camera.world_to_camera[:3, 3] /= SCALE  # the test knows the scale
    frames = [seq.frame(i) for i in (0, 6)]
    for frame in frames:
        frame.depth[...] /= SCALE
    assert off_the_plane(seq, 0) < most_mm and off_the_plane(seq, 6) < most_mm
    assert color_change(seq, 0, 6) < 4 and color_change(seq, 6, 0) < 4


def test_nerfstudio_lands_on_itself(nerfstudio):
    assert_lands(nerfstudio)
    assert remark_with(nerfstudio, "the scale of its poses is unknown")


@pytest.mark.parametrize("lens", [BENT, FISHEYE])
def test_distorted_images_are_undistorted(tmp_path, lens):
    assert_lands(write_nerfstudio(tmp_path / "scene", lens), 0.4)  # depth is that of the nearest pixel
    assert remark_with(tmp_path / "scene", "frames are undistorted")


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0"])
@pytest.mark.parametrize("kind", ["text", "binary"])
def test_colmap_lands_on_itself(tmp_path, kind, place):
    assert_lands(write_colmap(tmp_path / "scene", kind, place))


def test_colmap_with_distortion(tmp_path):
    assert_lands(write_colmap(tmp_path / "scene", "binary", lens=BENT), 0.4)


def test_the_lens_of_larger_images_is_scaled(nerfstudio):
    edit_json(nerfstudio / "transforms.json", w=192, h=160, fl_x=200, fl_y=208, cx=91, cy=84.5)
    assert_lands(nerfstudio)
    assert remark_with(nerfstudio, "200 px, is for 192x160 px; scaled to 100 px for 96x80")
    edit_json(nerfstudio / "transforms.json", w=192, h=150)
    assert_rejected(nerfstudio, "transforms.json", "the size of the images, 96x80 px, or that shape, got 192x150")


def test_the_angle_of_blender_is_a_focal_length(nerfstudio):
    angle = 2 * np.arctan(96 / 2 / 100)
    edit_json(nerfstudio / "transforms.json", camera_angle_x=angle, **dict.fromkeys(("fl_x", "fl_y", "w", "h")))
    camera = load_sequence(nerfstudio).camera(0)
    assert (camera.fx, camera.fy) == (pytest.approx(100), pytest.approx(100))


def edit_frames(folder, change):
    stored = json.loads((folder / "transforms.json").read_text())
    for frame in stored["frames"]:
        change(frame)
    (folder / "transforms.json").write_text(json.dumps(stored))


def test_masks_that_frames_name_say_what_to_ignore(nerfstudio):
    (nerfstudio / "masks").mkdir()
    mask = np.full((80, 96), 255, np.uint8)
    mask[:, :30] = 0
    for i in range(FRAMES):
        write(nerfstudio / f"masks/frame_{i:05d}.png", mask if i != 4 else 255 - mask)

    def name(frame):
        frame["mask_path"] = frame["file_path"].replace("images", "masks")

    assert load_sequence(nerfstudio).frame(0).tissue_mask.mean() == pytest.approx(30 / 96)  # 255 = tool, as ours
    edit_frames(nerfstudio, name)
    seq = load_sequence(nerfstudio)
    assert not seq.frame(0).tissue_mask[:, :30].any() and seq.frame(0).tissue_mask[:, 30:].all()
    assert seq.frame(4).tissue_mask[:, :30].all()


def test_paths_that_were_written_on_windows(nerfstudio, tmp_path):
    """Of images, masks and depth; and a name that holds a backslash is still found where there is one."""
    for kind in ("masks", "mm"):
        (nerfstudio / kind).mkdir()
    mask = np.full((80, 96), 255, np.uint8)
    mask[:, :30] = 0
    for i in range(FRAMES):
        write(nerfstudio / f"masks/frame_{i:05d}.png", mask)
        write(nerfstudio / f"mm/frame_{i:05d}.png", np.full((80, 96), 77, np.uint16))

    def name(frame):
        image = frame["file_path"].replace("/", "\\")
        parts = {"mask_path": image.replace("images", "masks"), "depth_file_path": image.replace("images", "mm")}
        frame |= {"file_path": f".\\{image}"} | parts

    poses = read_model_poses(nerfstudio, range(FRAMES))[0]
    edit_frames(nerfstudio, name)
    seq = load_sequence(nerfstudio)
    assert seq.image_names == [f"frame_{i:05d}" for i in range(FRAMES)]
    assert not seq.frame(0).tissue_mask[:, :30].any() and np.ptp(seq.frame(0).depth) == 0
    assert np.array_equal(read_model_poses(nerfstudio, range(FRAMES))[0], poses)
    (nerfstudio / "images/frame_00003.png").rename(nerfstudio / ".\\images\\frame_00003.png")
    assert len(load_sequence(nerfstudio)) == FRAMES
    edit_frames(nerfstudio, lambda frame: frame.update(file_path="C:\\" + frame["file_path"]))
    assert_rejected(nerfstudio, "transforms.json", "paths from its folder, got C:")


def test_colmap_names_that_were_written_on_windows(tmp_path):
    folder = write_colmap(tmp_path / "scene", "text")
    (folder / "images").rename(folder / "left")
    (folder / "images").mkdir()
    (folder / "left").rename(folder / "images" / "left")
    file = folder / "sparse/0/images.txt"
    file.write_text(file.read_text().replace("frame_", "left\\frame_"))
    assert load_sequence(folder).image_names[0] == "frame_00000"


def test_masks_of_colmap_are_called_after_the_image(tmp_path):
    folder = write_colmap(tmp_path / "scene", "text")
    (folder / "masks").mkdir()
    mask = np.full((80, 96), 255, np.uint8)
    mask[:20] = 0
    for i in range(FRAMES):
        write(folder / f"masks/frame_{i:05d}.png.png", mask)
    tissue = load_sequence(folder).frame(3).tissue_mask
    assert not tissue[:20].any() and tissue[20:].all()


def test_depth_that_frames_name_is_in_mm_and_poses_in_m(nerfstudio):
    (nerfstudio / "mm").mkdir()
    for i, to_world in enumerate(POSES):
        write(nerfstudio / f"mm/{i}.png", np.rint(500 * seen(MATRIX, to_world, SIZE)[1]).astype(np.uint16))

    def name(frame):
        i = int(frame["file_path"][-9:-4])
        frame["depth_file_path"] = f"mm/{i}.png"
        matrix = POSES[i] @ np.diag([1.0, -1, -1, 1])
        matrix[:3, 3] /= 1000
        frame["transform_matrix"] = matrix.tolist()

    edit_frames(nerfstudio, name)
    seq = load_sequence(nerfstudio, DataConfig(depth_unit_mm=0.002))
    assert not seq.depth_is_relative
    assert off_the_plane(seq, 8) < 0.02 and color_change(seq, 0, 6) < 4


def test_images_without_a_pose_are_left_out_and_counted(tmp_path):
    folder = write_colmap(tmp_path / "scene", "text")
    for name in ("frame_90000.png", "frame_90001.png"):
        write(folder / "images" / name, np.zeros((80, 96, 3), np.uint8))
    assert len(load_sequence(folder)) == FRAMES and remark_with(folder, "2 of 13 images have no pose and are left out")
    (folder / "images/frame_00003.png").unlink()
    assert len(load_sequence(folder)) == FRAMES - 1 and remark_with(folder, "1 of 11 images are not there")


def test_times_order_the_frames(nerfstudio):
    edit_frames(nerfstudio, lambda frame: frame.update(time=-int(frame["file_path"][-9:-4])))
    assert load_sequence(nerfstudio).image_names[0] == "frame_00010"


def test_a_prepared_folder_stays_what_it_is(tiny_sequence):
    (tiny_sequence / "transforms.json").write_text("{}")
    (tiny_sequence / "sparse/0").mkdir(parents=True)
    for name in ("cameras.txt", "images.txt"):
        (tiny_sequence / "sparse/0" / name).touch()
    assert load_sequence(tiny_sequence).camera(0).fx == 50


def test_check_reports_what_the_file_does_not_tell(nerfstudio):
    shutil.rmtree(nerfstudio / "depth")
    sequence = load_sequence(nerfstudio)
    found = {finding.code: finding for finding in find(measure(sequence))}
    assert found["no-depth-frames"].fix == "run `prepare` without `--depth`"
    prepare = f"`endoprior prepare {nerfstudio / 'images'} OUT --calibration {nerfstudio / 'transforms.json'} --poses "
    assert any(prepare in remark for remark in sequence.remarks)
    assert any("the scale of its poses is unknown" in remark for remark in sequence.remarks)


def first(**changes):
    def damage(folder):
        stored = json.loads((folder / "transforms.json").read_text())
        stored["frames"][0] |= changes
        (folder / "transforms.json").write_text(json.dumps(stored))

    return damage


def whole(**changes):
    return lambda folder: edit_json(folder / "transforms.json", **changes)


BAD = {
    "no frames": (whole(frames=None), "a list frames, got no such key"),
    "no file": (first(file_path=3), "file_path in frame 0, got 3"),
    "outside": (first(file_path="/etc/a.png"), "paths from its folder"),
    "no pose": (first(transform_matrix=None), "transform_matrix, 4x4 numbers, got no such key"),
    "pose NaN": (first(transform_matrix=(np.eye(4) * np.nan).tolist()), "NaN or infinity"),
    "singular pose": (first(transform_matrix=np.diag([0.0, 0, 0, 1]).tolist()), "rotations in the poses"),
    "projective pose": (first(transform_matrix=np.diag([1.0, 1, 1, 2]).tolist()), "a last row 0 0 0 1"),
    "scaled pose": (first(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()), "rotations in the poses"),
    "no focal length": (whole(fl_x=None), "fl_x and a PINHOLE, OPENCV or OPENCV_FISHEYE camera, got focal lengths 0"),
    "panorama": (whole(camera_model="EQUIRECTANGULAR"), "got the camera model EQUIRECTANGULAR in frame"),
    "k4": (whole(k4=0.1), "got k4 of another polynomial"),
    "text": (whole(cx="middle"), "cx to be a number, got 'middle'"),
    "NeuS2": (whole(from_na=True), "OpenGL camera axes, got those of NeuS2"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_of_nerfstudio_are_rejected(nerfstudio, case):
    damage, words = BAD[case]
    assert_damage_is_rejected(nerfstudio, damage, "transforms.json", words)


def cut(name, size):
    def damage(folder):
        file = folder / "sparse/0" / name
        file.write_bytes(file.read_bytes()[:size])

    return damage


def rewrite(name, text):
    return lambda folder: (folder / "sparse/0" / name).write_text(text)


BAD_COLMAP = {
    "cut cameras": ("binary", cut("cameras.bin", 20), "sparse/0/cameras.bin", "ends too early"),
    "cut images": ("binary", cut("images.bin", 500), "sparse/0/images.bin", "ends too early"),
    "words": ("text", rewrite("images.txt", "1 0 0 0 x\n"), "images.txt", "rows `IMAGE_ID QW"),
    "no images": ("text", rewrite("images.txt", "# none\n"), "images.txt", "registered images, got none"),
    "other camera": ("text", rewrite("cameras.txt", "4 PINHOLE 96 80 1 1 1 1\n"), "images.txt", "got camera 3"),
    "FOV": ("text", rewrite("cameras.txt", "3 FOV 96 80 1 1 1 1 1\n"), "cameras.txt", "got the camera model FOV"),
    "few": ("text", rewrite("cameras.txt", "3 PINHOLE 96 80 1\n"), "cameras.txt", "4 parameters of PINHOLE, got 1"),
}


def test_images_of_colmap_lie_below_its_folder(tmp_path):
    folder = write_colmap(tmp_path / "scene", "text")
    names = folder / "sparse/0/images.txt"
    names.write_text(names.read_text().replace("frame_00003.png", str(tmp_path / "elsewhere.png")))
    assert_rejected(folder, "sparse/0/images.txt", "paths from its folder")


@pytest.mark.parametrize("case", BAD_COLMAP)
def test_bad_models_of_colmap_are_rejected(tmp_path, case):
    kind, *damage = BAD_COLMAP[case]
    assert_damage_is_rejected(write_colmap(tmp_path / "scene", kind), *damage)


# --- `--poses` of the files of these programs


@pytest.mark.parametrize("kind", ["transforms.json", "text", "binary"])
def test_prepare_reads_their_poses_by_the_names_of_images(tmp_path, kind):
    folder = tmp_path / "scene"
    if kind == "transforms.json":
        given = write_nerfstudio(folder) / kind
    else:
        given = write_colmap(folder, kind) / "sparse/0"
    found, known, rule = read_model_poses(given, [1, 3, 4], [f"frame_{i:05d}" for i in range(FRAMES)])
    assert known.all() and rule == "matched by name"
    want = np.stack(POSES)[[1, 3, 4]]
    want[:, :3, 3] *= SCALE
    assert np.allclose(found, want)
    by_number, known, rule = read_model_poses(given if kind == "binary" else folder, range(FRAMES))
    assert np.allclose(by_number[[1, 3, 4]], want) and known.all() and "counted from 0" in rule
    out = tmp_path / "out"
    words = "--masks none --border keep --layout mono --depth none --poses-unit-mm".split()
    assert main(["prepare", str(folder / "images"), str(out), *words, repr(1 / SCALE), "--poses", str(given)]) == 0
    stored = np.load(out / "poses_bounds.npy")[:, :15].reshape(-1, 3, 5)
    assert np.allclose(stored[:, :, :4], np.stack(POSES)[:, :3], atol=1e-5)


def test_frames_without_a_pose_are_unexplained(tmp_path, capsys):
    folder = write_colmap(tmp_path / "scene", "text")
    lines = (folder / "sparse/0/images.txt").read_text().splitlines()
    del lines[5:7]  # the third image and its points
    (folder / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    out = tmp_path / "out"
    start, words = ["prepare", str(folder / "images")], "--masks none --border keep --layout mono --depth none --poses"
    words = words.split()
    assert main([*start, str(out), *words, str(folder)]) == 0
    assert "no camera pose, or another scene, in frame 2;" in capsys.readouterr().out
    assert json.loads((out / "sequence.json").read_text())["unexplained_frames"] == [2]
    assert main([*start, str(tmp_path / "y"), *words, str(folder), "--poses-convention", "llff"]) == 2
    assert "whose axes are known" in capsys.readouterr().err
    assert main([*start, str(tmp_path / "x"), *words, str(folder / "images")]) == 2
    assert "got a folder without a model" in capsys.readouterr().err
