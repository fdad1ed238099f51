"""Writes a new sequence folder, the EndoNeRF layout plus `sequence.json`. `T` frames.

`FrameFiles` writes into an existing folder. `new_sequence` writes a whole sequence: everything goes into a hidden
folder beside the target, which gets the target's name when it is complete.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..system.atomic import whole_folder
from .images import TOOL_VALUE, decode_image, encode_png, tool_mask_pixels
from .poses import POSES, depth_bounds, pose_table
from .scale import Scale

FARTHEST_UNIT = 65534  # of the depth files; 65535 stands for missing depth in the files of many programs
COMPRESSION = 2  # of the images; noise does not compress well anyway


@dataclass(frozen=True)
class SequenceMeta:
    """The facts of a sequence that its images do not hold."""

    width: int  # px, as the next five
    height: int
    fx: float
    fy: float
    cx: float  # the left-most pixel is centered at 0.5
    cy: float
    frames_per_second: float
    baseline_mm: float | None = None  # between the left and the right camera; None for a monocular sequence
    depth_scale: float = 0.01  # mm per unit of the 16-bit depth PNG
    depth_source: str | None = None  # origin of the depth, for example `stereo`; None without depth
    depth_relative: bool = False  # whether the depth's scale is assumed, so that lengths are not millimeters
    scale: Scale | None = None  # how relative depth was brought to mm: then `depth_scale` has its factor in it
    sources: dict[str, str] = field(default_factory=dict)  # origin of each part; no paths, which may hold names
    note: str = ""  # for users of the sequence

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) K, px; the left-most pixel is centered at 0.5."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])


class FrameFiles:
    """Writes the files of one frame after another into a folder, then what describes all of them."""

    def __init__(self, folder: Path, meta: SequenceMeta, count: int = 0) -> None:
        """Args: folder: to write to. meta: the facts. count: complete frames that are already in the folder."""
        self.folder, self.meta, self.count = folder, meta, count
        self.camera_to_world: NDArray[np.float64] | None = None
        """(T, 4, 4) poses of a camera that moves, for `new_sequence`; see `finish`."""

    def add(
        self,
        rgb: NDArray[np.uint8],
        tool_mask: NDArray[np.bool_],
        depth: NDArray[np.float32] | None = None,
        right: NDArray[np.uint8] | None = None,
    ) -> None:
        """Append one frame; arguments as in `encoded`."""
        self.append(self.encoded(rgb, tool_mask, depth, right))

    def encoded(
        self,
        rgb: NDArray[np.uint8],
        tool_mask: NDArray[np.bool_],
        depth: NDArray[np.float32] | None = None,
        right: NDArray[np.uint8] | None = None,
    ) -> dict[str, bytes]:
        """The files of one frame by folder: image, mask that is True on tools, and z in mm, 0 or not finite where it is
        missing. Several threads can encode at the same time.

        Depth and the image of the right camera are there in every frame of a sequence, or in none.
        """
        size = (self.meta.height, self.meta.width)
        for name, array in (("rgb", rgb), ("tool_mask", tool_mask), ("depth", depth), ("right", right)):
            if array is not None and array.shape[:2] != size:
                raise ValueError(f"{name} must be {size[0]} x {size[1]} pixels; got {array.shape}. Resize it first.")
        images: dict[str, NDArray] = {"images": rgb, "masks": tool_mask_pixels(tool_mask)}
        if depth is not None:
            images["depth"] = self.depth_units(depth)
        if right is not None:
            images["right"] = right
        return {folder: encode_png(pixels, COMPRESSION) for folder, pixels in images.items()}

    def append(self, encoded: dict[str, bytes]) -> None:
        """Write the files of the next frame, as `encoded` gave them."""
        for folder, data in encoded.items():
            self._file(f"{folder}/{self.count:06d}.png").write_bytes(data)
        self.count += 1

    def depth_units(self, depth: NDArray[np.float32]) -> NDArray[np.uint16]:
        """(H, W) z in mm as a file stores it; 0 where it is missing or too far."""
        units = np.round(np.where(np.isfinite(depth) & (depth > 0), depth, 0) / self.meta.depth_scale)
        return np.where(units <= FARTHEST_UNIT, units, 0).astype(np.uint16)

    def write_image(self, folder: str, pixels: NDArray, index: int | None = None) -> None:
        """Write an image (`encode_png`) of frame `index` as `folder`/NNNNNN.png; None: of the next frame that `add`
        appends.
        """
        number = self.count if index is None else index
        self._file(f"{folder}/{number:06d}.png").write_bytes(encode_png(pixels, COMPRESSION))

    def write_array(self, name: str, array: NDArray) -> None:
        """Write `name` (relative, `.npy`)."""
        np.save(self._file(name), array)

    def write_arrays(self, name: str, **arrays: NDArray) -> None:
        """Write named arrays to `name` (relative, `.npz`)."""
        np.savez_compressed(self._file(name), **arrays)  # pyright: ignore[reportArgumentType]  # allow_pickle: NumPy >= 2.1

    def write_json(self, name: str, content: dict[str, Any]) -> None:
        """Write `content` to `name` (relative, `.json`)."""
        self._file(name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8", newline="\n")

    def finish(
        self,
        camera_to_world: NDArray[np.float64] | None = None,
        unexplained_frames: Sequence[int] = (),
        frame_weights: Sequence[float] = (),
    ) -> None:
        """Write `poses_bounds.npy` and `sequence.json`.

        Args:
            camera_to_world: (T, 4, 4) mm, OpenCV axes; None for a static camera at the origin.
            unexplained_frames: frames with a problem that could not be resolved, such as no camera pose.
            frame_weights: how far each frame is to be believed, in [0, 1]; empty, or all 1, is not written.
        """
        if self.count == 0:
            raise ValueError("a sequence must have at least one frame; got none")
        meta = self.meta
        cameras = np.broadcast_to(np.eye(4), (self.count, 4, 4)) if camera_to_world is None else camera_to_world
        depths = [self.file("depth", index) for index in range(self.count)]
        stored = (decode_image(path, None) if path.exists() else np.zeros(0, np.uint16) for path in depths)
        bounds = np.array([depth_bounds(each, meta.depth_scale) for each in stored])
        self.write_array(POSES, pose_table(cameras, meta.height, meta.width, meta.fx, bounds))
        fixed = {"format_version": 1, "depth_unit": "mm", "mask_tool_value": TOOL_VALUE}
        known = asdict(replace(meta, scale=None))
        del known["scale"]
        described = fixed | known | {"unexplained_frames": [*unexplained_frames]}
        if meta.scale is not None:
            described |= meta.scale.described
        if min(frame_weights, default=1) < 1:
            described["frame_weights"] = [round(float(weight), 3) for weight in frame_weights]
        self.write_json("sequence.json", described)

    def file(self, folder: str, index: int) -> Path:
        """Path of the image of frame `index` in `folder`."""
        return self.folder / folder / f"{index:06d}.png"

    def _file(self, name: str) -> Path:
        """Path of a file in the folder; creates its parents."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


@contextmanager
def new_sequence(out: Path, meta: SequenceMeta) -> Iterator[FrameFiles]:
    """Collect the frames of one sequence; `out` appears complete when the block ends, and not at all after an error."""
    with whole_folder(Path(out)) as folder:
        files = FrameFiles(folder, meta)
        yield files
        files.finish(files.camera_to_world)
