"""Reader of prepared StereoMIS sequences: the EndoNeRF layout with `split.json`, as EndoPrior-GS writes it.

Poses are in mm and masks mark tools. Raw sequences are recognized only to explain how to prepare them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.shell import command
from .endonerf import load_endonerf
from .files import list_files, read_json
from .formats import Format
from .images import decode_image, read_values
from .sequence import FrameSequence, is_test_frame

RAW_FILE, POSES_FILE = "StereoCalibration.ini", "groundtruth.txt"


def is_stereomis(path: Path) -> bool:
    """Whether a folder is a StereoMIS sequence, prepared or raw."""
    return (path / RAW_FILE).exists() or ((path / "split.json").exists() and (path / "images").is_dir())


def load_stereomis(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a prepared sequence.

    8-bit depth is Omnidata's relative depth of unknown scale; 16-bit depth is in mm.
    """
    if not (path / "images").is_dir():
        raise input_error(path / RAW_FILE, "a prepared sequence", "a raw one", f"`{_preparing(path)}`.")
    count = len(list_files(path / "images", (".png",), "StereoMIS"))
    _check_split(path / "split.json", count)
    for folder in (path / "gt_masks" if cfg.use_gt_masks else path / "masks", path / "depth"):
        files = list_files(folder, (".png",), "StereoMIS")
        if len(files) != count:  # frames that are left out would move the published split
            fix = "add the missing files, or remove split.json to read the frames that have all."
            raise input_error(folder, f"{count} files, one per image", f"{len(files)}", fix)
    depth = decode_image(files[0], None)
    facts: dict[str, Any] = {}
    if depth.dtype == np.uint8:
        facts = {"depth_relative": True, "sources": {"depth": "Omnidata, relative, 8 bits"}}
    fact_files = [path / "split.json"]
    if (path / "intrinsics.npy").exists():
        facts |= _read_intrinsics(path / "intrinsics.npy")
        fact_files.append(path / "intrinsics.npy")
    return load_endonerf(path, cfg, facts=facts, fact_files=fact_files)


def _preparing(path: Path) -> str:
    """The command that prepares a raw sequence with the parts that are there."""
    videos = sorted(path.glob("*.mp4"))
    options: list[str | Path] = ["--calibration", path / RAW_FILE, "--layout", "top-bottom"]
    if (path / "masks").is_dir():
        options += ["--masks", path / "masks", "--mask-tool-value", "low"]
    if (path / POSES_FILE).is_file():
        options += ["--poses", path / POSES_FILE]
    return command("prepare", videos[0] if videos else path / "VIDEO.mp4", "OUT", *options)


def _read_intrinsics(path: Path) -> dict[str, float]:
    """fx, fy, cx, cy of the (3, 3) matrix in `intrinsics.npy`, whose pixel centers are integers."""
    hint = "write the 3x3 camera matrix of the rectified images."
    matrix = read_values(path)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise input_error(path, "a 3x3 camera matrix", f"shape {matrix.shape} or other numbers", hint)
    fx, fy, cx, cy = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return {"fx": fx, "fy": fy, "cx": cx + 0.5, "cy": cy + 0.5}


def _check_split(path: Path, count: int) -> None:
    """Raise InputError if the stored split is not the one that this program uses."""
    split = read_json(path)
    expected = {
        "test_indices": [i for i in range(count) if is_test_frame(i)],
        "train_indices": [i for i in range(count) if not is_test_frame(i)],
    }
    for key, indices in expected.items():
        stored = split.get(key)
        if not isinstance(stored, list):
            raise input_error(path, f"a list {key}", repr(stored), "prepare the sequence again.")
        if stored != indices:
            got = f"{len(stored)} frames that differ"
            want = f"{key} of the rule (i - 1) % 8 == 0, {len(indices)} frames"
            raise input_error(path, want, got, "remove split.json to use that rule.")


FORMAT = Format(is_stereomis, load_stereomis)
