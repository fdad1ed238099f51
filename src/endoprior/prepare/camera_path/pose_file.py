"""Camera poses from a file of the user: of each frame, or of the images of the video that the frames were made from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...core.checks import input_error
from ...data import nerfstudio
from ...data.colmap import model_folder, read_colmap
from ...data.files import in_order, read_table
from ...data.frame_files import match_names
from ...data.poses import demand_rotations
from ...data.reading import read_numpy

HINT = "Write (T, 4, 4) camera-to-world matrices in mm, OpenCV axes."
TEXT_SUFFIXES = (".txt", ".tum", ".freiburg", ".csv")
TEXT_HINT = "Write `frame x y z qx qy qz qw` in each row: camera to world, m."
MM_PER_M = 1000.0
FARTHEST_M = 2.0  # an endoscope does not move further; larger numbers are mm
UNIT_TOLERANCE = 0.01  # largest difference of a quaternion's length from 1 that rounding explains


def read_poses(path: Path, count: int, sources: Sequence[int] | None = None) -> NDArray:
    """(T, 4, 4) poses as the file has them; those of text in mm.

    Args:
        path: .npy of (T, 4, 4) or (T, 3, 4), or `poses_bounds.npy` (T, 17), one row per frame, mm; or text with
            `frame x y z qx qy qz qw` in each row, m, as StereoMIS and TUM have it, of the images of a video.
        sources: position in the video of each frame, from 0; None if the frames are of no video.
    """
    if path.suffix.lower() in TEXT_SUFFIXES:
        if sources is None:
            fix = "pass it to `endoprior prepare VIDEO OUT --poses`, which knows their frames and rectifies them."
            raise input_error(path, "poses of these frames, .npy", "poses of the images of a video", fix)
        return _of_images(path, sources)
    stored = read_numpy(path, "camera poses", HINT)
    shape = "an archive" if isinstance(stored, dict) else stored.shape or "an archive"
    if isinstance(stored, dict) or shape not in ((count, 4, 4), (count, 3, 4), (count, 17)):
        raise input_error(path, f"shape ({count}, 4, 4), one pose per frame", str(shape), HINT)
    if stored.dtype.kind not in "iuf":
        raise input_error(path, "numbers", str(stored.dtype), HINT)
    values = stored.astype(np.float64)
    if shape == (count, 17):
        values = values[:, :15].reshape(count, 3, 5)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3] = values[:, :3, :4]
    if not np.isfinite(poses).all():
        raise input_error(path, "finite numbers", "NaN or infinity", HINT)
    demand_rotations(path, poses[:, :3, :3], "the upper left 3x3", HINT)
    return poses


def is_model(path: Path) -> bool:
    """Whether a path is `transforms.json`, a model of COLMAP, or a folder with one."""
    return path.is_dir() or path.suffix.lower() == ".json" or path.name in ("images.txt", "images.bin")


def read_model_poses(
    path: Path, sources: Sequence[int], names: Sequence[str] = ()
) -> tuple[NDArray, NDArray[np.bool_], str]:
    """Poses that a reconstruction program wrote, of the frames that it has a pose for.

    Args:
        path: `transforms.json`, or a model of COLMAP: its folder, that above it, or its `images.txt` or `images.bin`.
        sources: position of each frame in the video or the folder of images, ascending.
        names: of all images of the folder, without suffixes; empty for a video.
    Returns:
        (T, 4, 4) camera-to-world in OpenCV axes, in units of the file, with the pose before it where a frame has none;
        (T,) whether a frame has one; and how they were matched.
    """
    folder = path if path.is_dir() else path.parent
    own = any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))
    model = folder if own else model_folder(folder)
    file = path / nerfstudio.FILE if path.is_dir() else path
    if file.suffix.lower() == ".json" and (file == path or (model is None and file.is_file())):
        stored = nerfstudio.read_poses(file)
    elif model is not None:
        stored = [(each.name, np.linalg.inv(each.world_to_camera)) for each in read_colmap(model)[0]]
    else:
        fix = "Pass the folder with COLMAP's cameras and images, .bin or .txt, or transforms.json."
        raise input_error(path, "camera poses", "a folder without a model", fix)
    by_name = {Path(name).name: pose for name, pose in stored}
    files = [file.name for file in in_order(map(Path, by_name))]
    matched = match_names(path, files, sources, names, required=())
    places = [matched.files.get(source) for source in sources]
    known = np.array([place is not None for place in places])
    before = np.maximum.accumulate(np.where(known, np.arange(len(places)), np.flatnonzero(known)[0]))
    poses = np.array([by_name[files[i]] for i in np.array(places)[before]], np.float64)
    demand_rotations(path, poses[:, :3, :3], "the poses", "Export them again.")
    return poses, known, matched.rule


def _of_images(path: Path, sources: Sequence[int]) -> NDArray:
    """(T, 4, 4) of the images at these positions of the video."""
    rows = read_table(path, TEXT_HINT)
    if rows.shape[1] != 8:
        raise input_error(path, "rows of 8 numbers", f"{rows.shape[1]}", TEXT_HINT)
    rows = rows[_rows_of(path, rows[:, 0], sources)]
    lengths = np.linalg.norm(rows[:, 4:], axis=1)
    wrong = np.flatnonzero(~(np.isfinite(rows).all(1) & (np.abs(lengths - 1) <= UNIT_TOLERANCE)))
    if wrong.size:
        got = f"length {lengths[wrong[0]]:g} of that of frame {wrong[0]}"
        raise input_error(path, "finite numbers and quaternions of length 1", got, TEXT_HINT)
    reach = np.linalg.norm(rows[:, 1:4] - rows[0, 1:4], axis=1).max()
    if reach > FARTHEST_M:
        got = f"a path that reaches {reach:g} from its start"
        raise input_error(path, f"positions in m, within {FARTHEST_M:g} m", got, "divide positions in mm by 1000.")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = MM_PER_M * rows[:, 1:4]
    return poses


def _rows_of(path: Path, numbers: NDArray, sources: Sequence[int]) -> NDArray[np.int_]:
    """(T,) the row of each image: by its number, from 0 or 1; in order where the first column holds times."""
    wanted = np.array(sources)
    counted = bool(np.isfinite(numbers).all() and (numbers == np.round(numbers)).all() and (np.diff(numbers) > 0).all())
    by_number = wanted + (0 if numbers[0] == 0 else 1)
    if counted and (numbers[0] <= 1 or np.isin(by_number, numbers).all()):
        rows, missing = np.searchsorted(numbers, by_number), by_number[~np.isin(by_number, numbers)]
    else:
        rows, missing = wanted, wanted[wanted >= len(numbers)]
    if missing.size:
        want, got = (
            "a row for each image of the video that is used",
            f"{len(numbers)} rows, none for image {missing[0]}",
        )
        raise input_error(path, want, got, "choose other images by --start and --end.")
    return rows
