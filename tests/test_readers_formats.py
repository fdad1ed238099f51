"""The choice of a layout: the registry, the option, the error; and EndoNeRF folders."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from reader_checks import assert_rejected, edit_json, remark_with

from endoprior.core.checks import InputError
from endoprior.core.config import DataConfig
from endoprior.data import load_sequence
from endoprior.data.formats import FORMATS
from endoprior.data.load import find_format

NAMES = list(FORMATS)


def touch(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"")
    return root


LOOKS = {
    "scared": ("data/frame_data/frame_data000000.json",),
    "scared raw": ("data/frame_data.tar.gz", "data/rgb.mp4"),
    "scared by its model": ("left_point_cloud.obj",),
    "c3vd": ("pose.txt", "0_color.png"),
    "stir": ("frames/0ms-9ms-visible.mp4", "segmentation/icgstartseg.png"),
    "stir root": ("calib.json", "left/seq00/segmentation/icgstartseg.png"),
    "stereomis": ("images/0.png", "masks/0.png", "depth/0.png", "poses_bounds.npy", "split.json"),
    "stereomis raw": ("P2_7.mp4", "StereoCalibration.ini", "groundtruth.txt", "masks/000001l.png"),
    "hamlyn": ("images/0.png", "gt_masks/0.png", "gt_depth/0.png", "poses_bounds.npy"),
    "nerfstudio": ("images/0.png", "transforms.json"),
    "colmap": ("images/0.png", "sparse/0/cameras.bin", "sparse/0/images.bin"),
    "hamlyn of Forplane": ("images/0.png", "gt_masks/0.png", "pred_disp/0.png", "intrinsics.txt"),
    "hamlyn for tracking": ("color/0.png", "depth/0.png", "intrinsics.txt"),
    "hamlyn rectified": ("image01/0.jpg", "depth01/0.png", "intrinsics.txt"),
    "endonerf": ("images/0.png", "masks/0.png", "depth/0.png", "poses_bounds.npy"),
    "endonerf without images": ("poses_bounds.npy",),
    "endonerf without poses": ("images/0.png", "masks/0.png", "depth/0.png"),
    "endonerf without depth": ("images/0.png", "masks/0.png", "poses_bounds.npy"),
    "no_depth": ("images/0.png", "masks/0.png", "poses_bounds.npy", "sequence.json"),
    "plain": ("images/0.jpg",),
    "plain with depth": ("images/0.png", "masks/0.png", "depth/0.npy"),
}


@pytest.mark.parametrize("case", LOOKS)
def test_layouts_are_recognized_by_names(tmp_path, case):
    assert find_format(touch(tmp_path, *LOOKS[case]), DataConfig()) == case.split()[0]


def test_an_unknown_name_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"data\.format: expected one of auto, scared, .*, got 'endo'\. Fix: "):
        load_sequence(tmp_path, DataConfig(format="endo"))


def test_every_layout_is_documented():
    page = (Path(__file__).parents[1] / "docs" / "datasets.md").read_text()
    for name in NAMES:
        assert re.search(rf"^## .*\(`{name}`\)$", page, re.MULTILINE), name


@pytest.mark.parametrize("name", NAMES)
def test_option_wins_over_what_the_folder_looks_like(tmp_path, name):
    assert find_format(touch(tmp_path, *LOOKS["plain"]), DataConfig(format=name)) == name


def test_unknown_folder_is_described(tmp_path):
    known = "scared, c3vd, stir, stereomis, hamlyn, no_depth, nerfstudio, colmap, endonerf, plain"
    assert_rejected(tmp_path, tmp_path.name, f"the layouts {known}, got an empty folder. Fix: See docs/datasets.md.")
    touch(tmp_path, *"abcdef", "g/x", ".hidden")
    assert_rejected(tmp_path, tmp_path.name, "got a, b, c, d, e and 2 more")


def test_pose_axes_belong_to_the_endonerf_layout(tmp_path):
    touch(tmp_path, *LOOKS["c3vd"])
    with pytest.raises(ValueError, match="pose_axes must be opencv for the c3vd layout"):
        load_sequence(tmp_path, pose_axes="opengl")


def test_endonerf_stride_and_unit(tiny_sequence):
    whole = load_sequence(tiny_sequence)
    part = load_sequence(tiny_sequence, DataConfig(stride=5, depth_unit_mm=0.02))
    assert len(part) == 4 and part.frames_per_second == 3
    np.testing.assert_array_equal(part.frame(2).rgb_u8, whole.frame(10).rgb_u8)
    np.testing.assert_allclose(part.frame(2).depth, 2 * whole.frame(10).depth, rtol=1e-6)
    assert part.frame(2).time == 0.5 and part.fingerprint() != whole.fingerprint()


def test_origins_of_an_endonerf_folder(tiny_sequence):
    seq = load_sequence(tiny_sequence)
    assert not seq.depth_is_relative and seq.sources == {} and seq.validate() == []
    sources = {"depth": "DepthAnything", "masks": "none"}
    edit_json(tiny_sequence / "sequence.json", depth_relative=True, sources=sources, unexplained_frames=[3])
    seq = load_sequence(tiny_sequence)
    assert seq.depth_is_relative and seq.sources == sources
    assert remark_with(tiny_sequence, "scale of its depth is unknown")
    assert remark_with(tiny_sequence, "1 of 17 frames have no camera pose")
    edit_json(tiny_sequence / "sequence.json", unexplained_frames=[-1])
    assert_rejected(tiny_sequence, "sequence.json", "unexplained_frames in 0..16, got -1")


def test_importing_the_package_is_light():
    code = "import sys, endoprior; print(sorted({'torch', 'cv2', 'scipy', 'OpenEXR'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
    code = "import sys, endoprior.data; print(sorted({'torch', 'scipy', 'OpenEXR'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
