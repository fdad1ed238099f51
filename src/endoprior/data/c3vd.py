"""Reader of C3VD's registered videos: colonoscope images of a phantom, with depth rendered from its registered model.

The images are omnidirectional; the reader resamples them, and their depth, to a pinhole camera. Scaramuzza's model: a
pixel at (u, v) from the center looks along (x, y, p(rho)), where (x, y) = A^-1 (u, v), rho = |(x, y)| and
p(rho) = a0 + a2 rho^2 + a3 rho^3 + a4 rho^4, with A = [[c, d], [e, 1]]. Pixel centers are integers there.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.types import Camera
from .assemble import Pixels, assemble, kept_frames
from .files import list_files
from .formats import DatasetFormat
from .images import read_color, read_values
from .poses import demand_rotations, world_to_camera
from .reading import read_table, read_text
from .sequence import FrameSequence

TABLE_STEPS_PER_PX = 16
"""Entries of the table that inverts p, per pixel of radius: the error is far below 1/1000 px."""
FARTHEST = 65535  # stored depth of all at or beyond 100 mm; 0 is outside the image circle or the model
POSES_HINT = "take pose.txt of the same video: 16 numbers per frame, camera to world."


@dataclass(frozen=True)
class Omnidirectional:
    """Intrinsics, px; `cx, cy` count pixel centers as integers."""

    width: int
    height: int
    cx: float
    cy: float
    a0: float
    a2: float
    a3: float
    a4: float
    c: float
    d: float
    e: float

    def forward(self, rho: NDArray[np.float64]) -> NDArray[np.float64]:
        """p(rho): how far forward a pixel at radius rho looks, in px."""
        return self.a0 + rho**2 * (self.a2 + rho * (self.a3 + rho * self.a4))

    def pinhole(self) -> tuple[float, float, float]:
        """(focal length, cx, cy), px, of the pinhole image of equal size; here pixel centers are halves.

        Its axis is the camera's own, and its nearest edge shows what the nearest edge of the original shows.
        """
        cx, cy = self.cx + 0.5, self.cy + 0.5
        nearest = min(cx, cy, self.width - cx, self.height - cy)
        return float(self.forward(np.asarray(nearest))), cx, cy

    def pinhole_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """x and y, (H, W) each, of the original pixel that each pixel of the pinhole image shows (`cv2.remap`).

        Raises:
            ValueError: p does not describe a camera: its angle does not grow with the radius.
        """
        focal, cx, cy = self.pinhole()
        x = (np.arange(self.width) + 0.5 - cx) / focal
        y = (np.arange(self.height)[:, None] + 0.5 - cy) / focal
        slope = np.hypot(x, y)  # tangent of the angle to the axis
        far = math.hypot(self.width, self.height)
        radii = np.linspace(0, far, math.ceil(far) * TABLE_STEPS_PER_PX)
        angles = np.arctan2(radii, self.forward(radii))
        # Beyond its last valid pixel a fitted polynomial may decrease again; the image must not reach that far.
        turns = np.flatnonzero(np.diff(angles) <= 0)
        valid = slice(0, turns[0] + 1 if turns.size else None)
        angle = np.arctan(slope)
        if focal <= 0 or angle.max() > angles[valid][-1]:
            raise ValueError("the polynomial a0, a2, a3, a4 does not describe a camera; correct the calibration")
        rho = np.interp(angle, angles[valid], radii[valid])
        # rho / slope has the limit p(0) on the axis.
        scale = np.where(slope > 1e-9, rho / np.maximum(slope, 1e-9), self.a0)
        x, y = x * scale, y * scale
        return (self.c * x + self.d * y + self.cx).astype(np.float32), (self.e * x + y + self.cy).astype(np.float32)


CF_HQ190L = Omnidirectional(
    width=1350,
    height=1080,
    cx=678.544839263292,
    cy=542.975887548343,
    a0=769.243600037458,
    a2=-0.000812770624150226,
    a3=6.25674244578925e-07,
    a4=-1.19662182144280e-09,
    c=0.999986882249990,
    d=0.00288273829525059,
    e=-0.00296316513429569,
)
"""The endoscope of the first edition of C3VD, as its authors calibrated it."""


def is_c3vd(path: Path) -> bool:
    """Whether a folder has `pose.txt` and images called `*_color.png`."""
    return (path / "pose.txt").exists() and any(path.glob("*_color.png"))


def load_c3vd(path: Path, cfg: DataConfig) -> FrameSequence:
    """Open a registered video."""
    images = list_files(path, (".png",), "C3VD", "_color")
    stored = {_number(file): file for file in list_files(path, (".tiff", ".tif"), "C3VD", "_depth")}
    if missing := [file for file in images if _number(file) not in stored]:
        name = f"{_number(missing[0]):04d}_depth.tiff"
        raise input_error(path / name, f"the depth of {missing[0].name}", "no such file", "unpack the video again.")
    poses = camera_to_world(path / "pose.txt", len(images))
    calibration = path / "config.ini"
    lens = read_lens(calibration) if calibration.exists() else CF_HQ190L
    size = (lens.width, lens.height)
    height, width = read_color(images[0]).shape[:2]
    if (width, height) != size:
        hint = "put the camera's width, height, cx, cy, a0, a2, a3, a4, c, d, e into config.ini beside them."
        raise input_error(images[0], f"{lens.width}x{lens.height} px, the calibrated size", f"{width}x{height}", hint)
    try:
        maps = lens.pinhole_maps()
    except ValueError as error:
        raise input_error(calibration, "the calibration of a camera", str(error), "correct it or remove it.") from None
    focal, cx, cy = lens.pinhole()
    kept = kept_frames(len(images), cfg)
    images = [images[i] for i in kept]
    depths = [stored[_number(file)] for file in images]
    moved = [world_to_camera(poses[i, :3, :3], poses[i, :3, 3]) for i in kept]
    mm_per_unit = cfg.depth_unit_mm or 100 / FARTHEST

    def decode(index: int) -> Pixels:
        # The nearest depth, so that depths do not mix across an edge; 0 outside of the original, where no tissue is.
        units = np.asarray(cv2.remap(read_values(depths[index], size), *maps, cv2.INTER_NEAREST), np.float32)
        depth = np.where(units < FARTHEST, units * np.float32(mm_per_unit), np.float32(0))
        color = cv2.remap(read_color(images[index], size), *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(color, np.uint8), units > 0, depth

    return assemble(
        path,
        cfg,
        [Camera(width, height, focal, focal, cx, cy, pose) for pose in moved],
        decode,
        images=images,
        files=[*depths, path / "pose.txt", *([calibration] if calibration.exists() else [])],
        clip_depth=False,
        remarks=[f"{path}: omnidirectional images, resampled to a pinhole camera of {focal:.1f} px focal length"],
        mask_folder=".",
        sources={"depth": "rendered from the registered model", "poses": "registration of the robot's log"},
    )


def camera_to_world(path: Path, count: int) -> NDArray[np.float64]:
    """(N, 4, 4) poses of `pose.txt`, translation in mm.

    The files are column-major, although C3VD's page says row-major; the position of (0, 0, 0, 1) decides.
    """
    rows = read_table(path, POSES_HINT)
    if rows.shape != (count, 16):
        raise input_error(path, f"{count} rows of 16 numbers, one per image", f"shape {rows.shape}", POSES_HINT)
    for poses in (rows.reshape(-1, 4, 4).transpose(0, 2, 1), rows.reshape(-1, 4, 4)):
        if (poses[:, 3] == (0, 0, 0, 1)).all() and np.isfinite(poses).all():
            demand_rotations(path, poses[:, :3, :3], "each pose", POSES_HINT)
            return poses
    raise input_error(path, "finite rigid transforms", "NaN, infinity or no row 0, 0, 0, 1", POSES_HINT)


def read_lens(path: Path) -> Omnidirectional:
    """The camera in a file of lines `name = number` (or with a colon); other lines are ignored."""
    text = read_text(path, "camera parameters", "write it again.")
    entries = dict(re.findall(r"^\s*(\w+)\s*[=:]\s*([-+.\deE]+)\s*;?\s*$", text, re.MULTILINE))
    values = {}
    for name, field in Omnidirectional.__dataclass_fields__.items():
        try:
            values[name] = int(entries[name]) if field.type == "int" else float(entries[name])
        except (KeyError, ValueError):
            hint = "add a line such as a0 = 769.2."
            raise input_error(path, f"a number {name}", repr(entries.get(name, "none")), hint) from None
    return Omnidirectional(**values)


def _number(file: Path) -> int:
    """Frame number in a name such as `12_color.png` or `0012_depth.tiff`."""
    if not (digits := re.match(r"[0-9]+", file.name)):
        raise input_error(file, "a name that starts with the frame's number", file.name, "rename or remove it.")
    return int(digits[0])


FORMAT = DatasetFormat(is_c3vd, load_c3vd)
