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
from ...data.files import in_order, portable
from ...data.frame_files import match_names
from ...data.poses import demand_rotations
from ...data.reading import read_numpy, read_table

HINT = "Write (T, 4, 4) camera-to-world matrices in mm, OpenCV axes."
TEXT_SUFFIXES = (".txt", ".tum", ".freiburg", ".csv", ".kitti")
TEXT_HINT = "Write `time x y z qx qy qz qw` (TUM) or 3x4 numbers (KITTI) in each row: camera to world, m."
TUM, KITTI = 8, 12  # numbers in a row
MM_PER_M = 1000.0
FARTHEST_M = 2.0  # an endoscope does not move further; larger numbers are mm
UNIT_TOLERANCE = 0.01  # largest difference of a quaternion's length from 1 that rounding explains


def read_poses(path: Path, count: int, sources: Sequence[int] | None = None) -> NDArray:
    """(T, 4, 4) poses as the file has them; those of text in mm.

    Args:
        path: .npy of (T, 4, 4) or (T, 3, 4), or `poses_bounds.npy` (T, 17), one row per frame, mm; or text, m.
        sources: as in `read_text_poses`.
    """
    if is_text(path):
        poses, _ = read_text_poses(path, count, sources)
        poses[:, :3, 3] *= MM_PER_M
        return poses
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
    by_name = {Path(portable(name)).name: pose for name, pose in stored}
    files = [file.name for file in in_order(map(Path, by_name))]
    matched = match_names(path, files, sources, names, required=())
    places = [matched.files.get(source) for source in sources]
    known = np.array([place is not None for place in places])
    before = np.maximum.accumulate(np.where(known, np.arange(len(places)), np.flatnonzero(known)[0]))
    poses = np.array([by_name[files[i]] for i in np.array(places)[before]], np.float64)
    demand_rotations(path, poses[:, :3, :3], "the poses", "Export them again.")
    return poses, known, matched.rule


def is_text(path: Path) -> bool:
    """Whether a file has a pose in each line."""
    return path.suffix.lower() in TEXT_SUFFIXES


def read_text_poses(
    path: Path,
    count: int,
    sources: Sequence[int] | None = None,
    image_times: Sequence[float] = (),
    unit_mm: float = MM_PER_M,
) -> tuple[NDArray, str]:
    """Poses of TUM's text (StereoMIS' too), `time x y z qx qy qz qw`, or of KITTI's, 3x4 numbers in a row.

    Args:
        count: of the frames.
        sources: position in the video of each frame, from 0; None if the frames are of no video.
        image_times: of all images of the video, or else of all frames, s; empty where they are not known.
        unit_mm: mm per unit of the positions.
    Returns:
        (T, 4, 4) poses of the frames, in units of the file; and how its rows were matched.
    """
    rows = read_table(path, TEXT_HINT)
    if rows.shape[1] not in (TUM, KITTI):
        raise input_error(path, f"rows of {TUM} or {KITTI} numbers", f"{rows.shape[1]}", TEXT_HINT)
    numbers = rows[:, 0] if rows.shape[1] == TUM else None
    chosen, rule = _rows_of(path, numbers, len(rows), count, sources, image_times)
    rows = rows[chosen]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if numbers is None:
        if not np.isfinite(rows).all():
            raise input_error(path, "finite numbers", "NaN or infinity", TEXT_HINT)
        poses[:, :3] = rows.reshape(-1, 3, 4)
        demand_rotations(path, poses[:, :3, :3], "the left 3x3 of each row", TEXT_HINT)
    else:
        lengths = np.linalg.norm(rows[:, 4:], axis=1)
        wrong = np.flatnonzero(~(np.isfinite(rows).all(1) & (np.abs(lengths - 1) <= UNIT_TOLERANCE)))
        if wrong.size:
            got = f"length {lengths[wrong[0]]:g} of that of frame {wrong[0]}"
            raise input_error(path, "finite numbers and quaternions of length 1", got, TEXT_HINT)
        poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
        poses[:, :3, 3] = rows[:, 1:4]
    reach = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max()
    if reach * unit_mm > FARTHEST_M * MM_PER_M:
        got = f"a path that reaches {reach * unit_mm / MM_PER_M:g} from its start"
        want, fix = f"positions in m, within {FARTHEST_M:g} m", "for positions in mm: `--poses-unit-mm 1`."
        raise input_error(path, want, got, fix)
    return poses, rule


def _rows_of(
    path: Path,
    numbers: NDArray | None,
    num_rows: int,
    count: int,
    sources: Sequence[int] | None,
    image_times: Sequence[float],
) -> tuple[NDArray[np.int_], str]:
    """(T,) the row of each frame, and the rule: by number, from 0 or 1; by time; or in order.

    Args:
        numbers: (R,) the first column, numbers of images or times; None if there is no such column.
    """
    images = np.arange(count) if sources is None else np.array(sources)
    missing, counted = images[images >= num_rows], False
    if numbers is not None and np.isfinite(numbers).all():
        counted = bool((numbers == np.round(numbers)).all() and (np.diff(numbers) > 0).all())
    if numbers is not None and counted:
        by_number = images + (0 if numbers[0] == 0 else 1)
        there = np.isin(by_number, numbers)
        if there.all() and sources is not None:
            return np.searchsorted(numbers, by_number), "by the numbers of the images"
        if numbers[0] <= 1:
            missing = by_number[~there]  # they are numbers of other images: their order says nothing
    elif not missing.size and num_rows == (len(image_times) or num_rows):
        return images, "in order, one for each image"
    if numbers is not None and (by_time := _by_time(numbers, images, image_times)) is not None:
        return by_time, "by time"
    if sources is None and counted:
        fix = "pass it to `endoprior prepare VIDEO OUT --poses`, which knows their frames and rectifies them."
        raise input_error(path, "poses of these frames, .npy", "poses of the images of a video", fix)
    if counted and not missing.size and num_rows == (len(image_times) or num_rows):
        return images, "in order, one for each image"
    if num_rows == count and not counted:
        return np.arange(count), "in order, one for each frame"
    want = "a row for each image of the video that is used"
    got = f"{num_rows} rows, none for image {missing[0]}" if missing.size else f"{num_rows} rows of other times"
    raise input_error(path, want, got, "choose other images by --start and --end.")


def _by_time(times: NDArray, images: NDArray, image_times: Sequence[float]) -> NDArray[np.int_] | None:
    """(T,) the row nearest to each frame in time; None where one has none within half the time between images.

    Times count from the start of the video, or from the first row: that of its first image, or of the first frame.
    """
    increase = np.isfinite(times).all() and (np.diff(times) > 0).all()
    if not len(image_times) or images.max() >= len(image_times) or len(times) < len(images) or not increase:
        return None
    wanted = np.array(image_times)[images]
    tolerance = np.median(np.diff(image_times)) / 2 if len(image_times) > 1 else 0.0
    for since in (0.0, times[0], times[0] - wanted[0]):
        at = np.searchsorted((times[1:] + times[:-1]) / 2 - since, wanted)
        if (np.abs(times[at] - since - wanted) <= tolerance).all() and (np.diff(at) > 0).all():
            return at
    return None
