"""Made-up folders in the layout of the published clips: EndoNeRF's and SCARED's, of any number of frames and size."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
from conftest import write_tiny_sequence

BASELINE_MM = 4.0


def write_endonerf(folder: Path, frames: int, width: int, height: int) -> Path:
    """As the EndoNeRF data comes: names with a dash, depth in whole mm, `gt_masks/`, no `sequence.json`."""
    write_tiny_sequence(folder, frames, width, height)
    (folder / "sequence.json").unlink()
    for name, kind in (("images", "color"), ("masks", "mask"), ("depth", "depth")):
        for i, file in enumerate(sorted((folder / name).iterdir())):
            if name == "depth":
                fine = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
                cv2.imwrite(str(file), np.rint(fine / 100).astype(np.uint8))
            file.rename(file.with_name(f"frame-{i:06d}.{kind}.png"))
    shutil.copytree(folder / "masks", folder / "gt_masks")
    return folder


def write_scared(folder: Path, frames: int, width: int, height: int) -> Path:
    """As processed keyframes come, version 1, with a camera that stands still and no tool; `folder` holds `data/`."""
    made, data = write_tiny_sequence(folder / "made", frames, width, height), folder / "data"
    focal = np.load(made / "poses_bounds.npy")[0, 14]
    matrix = [[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]]
    back = [[1, 0, 0, -matrix[0][2]], [0, 1, 0, -matrix[1][2]], [0, 0, 0, focal], [0, 0, 1 / BASELINE_MM, 0]]
    for name in ("frame_data", "left_finalpass", "disparity", "reprojection_data"):
        (data / name).mkdir(parents=True)
    for i in range(frames):
        name, source = f"frame_data{i:06d}", f"{i:06d}.png"
        (made / "images" / source).rename(data / "left_finalpass" / f"{name}.png")
        depth = cv2.imread(str(made / "depth" / source), cv2.IMREAD_UNCHANGED) / 100
        disparity = np.where(depth > 0, focal * BASELINE_MM / np.maximum(depth, 1), 0)
        cv2.imwrite(str(data / "disparity" / f"{name}.tiff"), disparity.astype(np.float32))
        record = {"camera-calibration": {"KL": matrix}, "camera-pose": np.eye(4).tolist()}
        (data / "frame_data" / f"{name}.json").write_text(json.dumps(record))
        (data / "reprojection_data" / f"{name}.json").write_text(json.dumps({"reprojection-matrix": back}))
    shutil.rmtree(made)
    return folder
