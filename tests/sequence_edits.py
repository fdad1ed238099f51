"""Small changes to a sequence folder, for tests of the reader."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np


def write(path: Path, pixels: np.ndarray) -> None:
    """Write an image; channels in OpenCV's order."""
    assert cv2.imwrite(str(path), pixels)


def describe(folder: Path, **changes: object) -> None:
    """Change fields of sequence.json; None removes one."""
    path = folder / "sequence.json"
    described = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({k: v for k, v in described.items() if v is not None}))


def change_poses(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Replace poses_bounds.npy by a function of itself."""
    path = folder / "poses_bounds.npy"
    poses = np.load(path)
    np.save(path, change(poses))


def edit(folder: Path, change: Callable[[np.ndarray, int], np.ndarray]) -> None:
    """Replace every image of a folder by a function of it and its position."""
    for position, file in enumerate(sorted(folder.iterdir())):
        write(file, change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), position))
