"""Camera poses from a file of the user."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.checks import input_error
from ...data.numpy_files import read_numpy
from ...data.poses import demand_rotations


def read_poses(path: Path, count: int) -> NDArray[np.float64]:
    """(T, 4, 4) camera-to-world in mm from .npy of (T, 4, 4) or (T, 3, 4), or from `poses_bounds.npy` (T, 17).

    Raises:
        InputError: the file is unreadable, has another shape, or holds values that are not rotations.
    """
    hint = "Write (T, 4, 4) camera-to-world matrices in mm, OpenCV axes."
    stored = read_numpy(path, "camera poses", hint)
    shape = getattr(stored, "shape", None)
    if shape not in ((count, 4, 4), (count, 3, 4), (count, 17)):
        raise input_error(path, f"shape ({count}, 4, 4), one pose per frame", str(shape or "an archive"), hint)
    if stored.dtype.kind not in "iuf":
        raise input_error(path, "numbers", str(stored.dtype), hint)
    values = stored.astype(np.float64)
    if shape == (count, 17):
        values = values[:, :15].reshape(count, 3, 5)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3] = values[:, :3, :4]
    if not np.isfinite(poses).all():
        raise input_error(path, "finite numbers", "NaN or infinity", hint)
    demand_rotations(path, poses[:, :3, :3], "the upper left 3x3", hint)
    return poses
