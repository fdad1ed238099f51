"""What frames are scored against, never trained on: the truth of a synthetic sequence, and the right eye's pictures."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..core.geometry import FARTHEST_MM, Strain
from .description import MAX_NUMBER, MIN_NUMBER, is_number
from .files import IMAGE_SUFFIXES, files_with
from .frame_files import match_names
from .images import Size, read_color, read_header
from .pixels import shrunk_color
from .poses import ROTATION_TOLERANCE, demand_rotations
from .reading import read_bytes, read_json, read_numpy

_AGAIN = "write the truth again."


@dataclass(frozen=True)
class Tracks:
    """Material points that move with the tissue."""

    points: NDArray[np.float32]  # (T, P, 3) positions in camera axes, mm
    visible: NDArray[np.bool_]  # (T, P) True where the point is in the image and not occluded
    paired: bool = True  # False if points of both ends are not matched, as in STIR: each is visible once
    region: NDArray[np.str_] | None = None
    """(P,) part of the tissue each point lies in, such as `pulled` or `smooth`; None if unknown."""


@dataclass(frozen=True)
class Deformation:
    """How the tissue at the points of the tracks is deformed since the first frame; axes of the first camera."""

    displacement: NDArray[np.float32]  # (T, P, 3) mm
    strain: Strain  # (T, P)


class Truth:
    """The `truth/` folder of a sequence; files are read when used, missing parts are None."""

    def __init__(self, folder: Path, names: list[str]) -> None:
        """Args: folder: the `truth/` folder. names: stem of each frame's files, in the order of the sequence."""
        self.folder = folder
        self._names = names

    def _stored(self, name: str) -> NDArray | dict[str, NDArray] | None:
        """What a NumPy file of the folder holds; None without."""
        path = self.folder / name
        return read_numpy(path, "a NumPy file", _AGAIN) if path.exists() else None

    def _map(self, name: str) -> NDArray | None:
        """The numbers (H, W) of a NumPy file of the folder; None without."""
        stored = self._stored(name)
        return None if stored is None else _numbers(self.folder / name, stored, (None, None))

    def tissue(self, index: int) -> NDArray[np.uint8] | None:
        """(H, W, 3) image of frame `index` without the tool, 0..255."""
        path = self.folder / "tissue" / f"{self._names[index]}.png"
        return read_color(path) if path.parent.is_dir() else None

    @property
    def has_no_highlights(self) -> bool:
        """Whether some frames are known without highlights."""
        return (self.folder / "no_highlights").is_dir()

    def no_highlights(self, index: int) -> NDArray[np.uint8] | None:
        """(H, W, 3) image of frame `index` without the tool and without highlights, 0..255; None without."""
        path = self.folder / "no_highlights" / f"{self._names[index]}.png"
        return read_color(path) if path.is_file() else None

    def depth(self, index: int) -> NDArray[np.float32] | None:
        """(H, W) exact z of the tissue of frame `index`, tool ignored, mm."""
        path = self.folder / "depth" / f"{self._names[index]}.npy"
        if not path.parent.is_dir():
            return None
        return _numbers(path, read_numpy(path, "a NumPy file", _AGAIN), (None, None)).astype(np.float32)

    def seen(self, index: int) -> NDArray[np.bool_] | None:
        """(H, W) True behind the tool of frame `index` where some training frame shows that tissue; None without."""
        stored = self._map(f"seen/{self._names[index]}.npy")
        return None if stored is None else stored.astype(bool)

    def printed_over(self, index: int) -> NDArray[np.bool_] | None:
        """(H, W) True on the border around frame `index` and on drawings over it, which are no tools; None without."""
        parts = [self._map(name) for name in ("border.npy", f"overlay/{self._names[index]}.npy")]
        found = [part.astype(bool) for part in parts if part is not None]
        return np.logical_or.reduce(found) if found else None

    @cached_property
    def side_poses(self) -> dict[str, NDArray[np.float64]]:
        """Cameras beside the endoscope by name: (4, 4) rigid transforms from the frame's camera axes; empty without."""
        path = self.folder / "side" / "world_to_camera.json"
        if not path.exists():
            return {}
        try:
            poses = {name: np.asarray(pose, np.float64) for name, pose in read_json(path).items()}
        except (TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            poses = {"": np.zeros(0)}
        if not all(pose.shape == (4, 4) and np.isfinite(pose).all() for pose in poses.values()):
            raise input_error(path, "finite poses of shape (4, 4)", "something else", _AGAIN)
        return poses

    def side(self, name: str, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]] | None:
        """(H, W, 3) picture, 0..255, and (H, W) z, mm, of a side camera in frame `index`; None without.

        Both are 0 where the endoscope does not see the tissue.
        """
        file = f"side/{name}/{self._names[index]}"
        depth = self._map(f"{file}.npy")
        return None if depth is None else (read_color(self.folder / f"{file}.png"), depth.astype(np.float32))

    @cached_property
    def camera_to_world(self) -> NDArray[np.float64] | None:
        """(T, 4, 4) true pose of each frame's camera, mm, OpenCV axes; world axes may differ from the sequence's."""
        path, stored = self.folder / "camera_to_world.npy", self._stored("camera_to_world.npy")
        if stored is None:
            return None
        poses = _numbers(path, stored, (len(self._names), 4, 4)).astype(np.float64)
        if not (np.abs(poses) <= FARTHEST_MM).all():  # NaN fails too
            raise input_error(path, f"finite numbers of at most {FARTHEST_MM:g}", "others", _AGAIN)
        if not np.allclose(poses[:, 3], (0, 0, 0, 1), rtol=0, atol=ROTATION_TOLERANCE):
            raise input_error(path, "poses with the last row 0 0 0 1", "another last row", _AGAIN)
        demand_rotations(path, poses[:, :3, :3], "the poses", _AGAIN)
        return poses

    @cached_property
    def tracks(self) -> Tracks | None:
        """All tracks, or None."""
        path, stored = self.folder / "tracks.npz", self._stored("tracks.npz")
        if stored is None:
            return None
        if not isinstance(stored, dict) or not {"points", "visible"} <= stored.keys():
            got = ", ".join(stored) if isinstance(stored, dict) else "one array"
            raise input_error(path, "arrays points and visible", got, _AGAIN)
        visible = _numbers(path, stored["visible"], (len(self._names), None), "visible").astype(bool)
        points = _numbers(path, stored["points"], (*visible.shape, 3), "points").astype(np.float32)
        paired = _numbers(path, stored.get("paired", np.array(True)), (), "paired")
        region = stored["region"].astype(str) if "region" in stored else None
        if region is not None and region.shape != visible.shape[1:]:
            raise input_error(path, f"a region of shape {visible.shape[1:]}", f"{region.shape}", _AGAIN)
        return Tracks(points, visible, bool(paired), region)

    @cached_property
    def deformation(self) -> Deformation | None:
        """How the tissue of the tracks is deformed, or None."""
        path, stored, tracks = self.folder / "mechanics.npz", self._stored("mechanics.npz"), self.tracks
        if stored is None:
            return None
        if tracks is None:
            raise input_error(path, "tracks.npz beside it, with its points", "none", _AGAIN)
        sizes = {"displacement": 3, "stretch": 2, "direction": 3}
        found = stored if isinstance(stored, dict) else {}
        for name, size in sizes.items():
            array = _numbers(path, found.get(name), (*tracks.visible.shape, size), name)
            if not np.isfinite(array).all():
                raise input_error(path, f"{name}: finite numbers", "NaN or infinity", _AGAIN)
        strain = Strain(*(found[name].astype(np.float64) for name in ("stretch", "direction")))
        return Deformation(found["displacement"].astype(np.float32), strain)


def _numbers(path: Path, stored: Any, shape: tuple[int | None, ...], name: str = "") -> NDArray:
    """What a NumPy file holds, or its array of that name, if it is one array of real numbers of a shape; None: any."""
    known = isinstance(stored, np.ndarray) and stored.dtype.kind in "biuf" and stored.ndim == len(shape)
    if known and all(want in (None, got) for want, got in zip(shape, stored.shape, strict=True)):
        return stored
    got = "no such array" if stored is None else "several arrays"
    if isinstance(stored, np.ndarray):
        got = f"{stored.shape} of {stored.dtype}"
    sides = ", ".join("any" if side is None else str(side) for side in shape)
    raise input_error(path, f"{f'{name}: ' if name else ''}numbers of shape ({sides})", got, _AGAIN)


@dataclass(frozen=True)
class RightEye:
    """The right pictures of a rectified pair; each is decoded when it is used.

    The right camera has the lens of the left one, turned like it, and stands `baseline_mm` along its +x axis.
    """

    files: list[Path]  # of each frame
    baseline_mm: float
    size: Size  # of the files, px
    shrink: int = 1  # pictures are this many times smaller than the files

    def part(self, start: int, stop: int) -> RightEye:
        """The pictures of frames `start` to `stop` - 1."""
        return replace(self, files=self.files[start:stop])

    def image(self, index: int) -> NDArray[np.uint8]:
        """(H, W, 3) right picture of frame `index` at the size of the left one, 0..255."""
        return shrunk_color(read_color(self.files[index], self.size), self.shrink)


def open_right_eye(
    path: Path,
    images: list[Path],
    kept: list[int],
    size: Size,
    described: dict[str, Any],
    shrink: int,
    remarks: list[str],
    *,
    relative: bool,
) -> RightEye | None:
    """The right eye of a sequence folder, if it has one that can be used; else a remark says why not.

    Args:
        images, size: the left picture of every frame in the folder, and their (width, height), px.
        kept: positions in `images` of the frames to read.
        described: contents of `sequence.json`, of which `baseline_mm` is used.
        relative: whether the scale of depth is unknown: then a baseline in mm does not fit the scene.
    """
    folder = path / "right"
    if not folder.is_dir():
        return None
    files, baseline = files_with(folder, IMAGE_SUFFIXES), described.get("baseline_mm")
    reason, matched = "", None
    with suppress(InputError):
        names = [file.stem for file in images]
        matched = match_names(folder, [file.name for file in files], range(len(images)), names) if files else None
    if matched is None:
        reason = f"it has {len(files)} images, not one of the name or number of each of the {len(images)} in images/"
    elif baseline is None:
        reason = "sequence.json has no baseline_mm, the distance between the cameras"
    elif not is_number(baseline):
        reason = (
            f"baseline_mm in sequence.json is {repr(baseline)[:60]}, not a number in [{MIN_NUMBER:g}, {MAX_NUMBER:g}]"
        )
    elif relative:
        reason = "the scale of the depth is unknown, and the distance between the cameras is in mm"
    elif not (found := read_header(read_bytes(files[matched.files[0]]).tobytes())) or found[:2] != size:
        got = f"{found.width}x{found.height} px" if found else "no size that can be read"
        reason = f"its first image has {got}, and the left one {size[0]}x{size[1]} px"
    if reason or matched is None or baseline is None:
        remarks.append(f"{folder}: ignored, because {reason}")
        return None
    remarks += [f"{folder}: {matched.rule}"] if "in order" in matched.rule else []
    return RightEye([files[matched.files[i]] for i in kept], float(baseline), size, shrink)
