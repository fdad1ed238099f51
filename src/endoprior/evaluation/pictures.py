"""Frames that another program rendered, read from files and scored like our own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.types import Camera
from ..data import FrameSequence, Split, read_depth_file
from ..data.files import digests_of, entries, files_with, fingerprint_of
from ..data.frame_files import HINT, match_names
from ..data.images import decode_image, describe_pixels, single_channel
from ..data.reading import kind_of
from .context import Rendering
from .score import ScoreUnavailable

FULL_SCALE = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}


class Pictures:
    """A `Reconstruction` whose frames are PNG files, and its depth, if there is any, NPY or PNG files."""

    def __init__(
        self,
        folder: Path,
        sequence: FrameSequence,
        split: Split,
        *,
        depth_folder: Path | None = None,
        depth_scale: float | None = None,
        name: str = "",
    ) -> None:
        """Find the file of every frame, or raise InputError; they are decoded when they are used.

        Args:
            folder: RGB images of 8 or 16 bits, of the size of the sequence's frames.
            split: frames that must be there; scores that need others are skipped if these are not.
            depth_folder: NPY files in mm, or 16-bit PNG files, which need `depth_scale`, mm per unit.
            name: of the method, for `metrics.json`; default: the folder's.
        """
        self._sequence, self._scale = sequence, depth_scale
        self._color, rule = _matched(folder, (".png",), sequence, split)
        facts: dict[str, Any] = {"name": name or folder.resolve().name, "folder": str(folder.resolve())}
        facts |= {"files": len(self._color), "matched_by": rule, "fingerprint": fingerprint(folder)}
        first = next(iter(self._color.values()))
        facts["bits"] = 8 * decode_image(first, None).dtype.itemsize
        self._depth: dict[int, Path] = {}
        if depth_folder:
            self._depth, rule = _matched(depth_folder, (".npy", ".png"), sequence, split)
            if depth_scale is None and any(file.suffix.lower() == ".png" for file in self._depth.values()):
                fix = "pass --depth-scale, or `depth_scale` in a spec."
                raise input_error(depth_folder, "mm per unit of PNG files", "none", fix)
            facts |= {"depth_folder": str(depth_folder.resolve()), "depth_matched_by": rule}
            facts |= {"depth_scale": depth_scale, "depth_fingerprint": fingerprint(depth_folder)}
        self.provenance = {"pictures": facts}

    @property
    def remarks(self) -> list[str]:
        """How files and frames were matched, one line for each folder."""
        facts, total = self.provenance["pictures"], len(self._sequence)
        folders = {"": self._color, "depth_": self._depth}
        return [
            f"{facts[kind + 'folder']}: {len(files)} of {total} frames, {facts[kind + 'matched_by']}"
            for kind, files in folders.items()
            if files
        ]

    def render(self, index: int) -> Rendering:
        """See `Reconstruction.render`; InputError for a file that cannot be used."""
        if index not in self._color:
            raise ScoreUnavailable(f"needs more frames: there is no image of frame {index}")
        camera, depth = self._sequence.camera(index), self._depth.get(index)
        return _read_color(self._color[index], camera), depth and _read_depth(depth, self._scale, camera)


def fingerprint(folder: Path, suffixes: tuple[str, ...] = (".png", ".npy")) -> str:
    """SHA-256, in hex, of the names and contents of the files of a folder with one of the suffixes."""
    files = [file for file in entries(folder) if file.is_file() and file.suffix.lower() in suffixes]
    return fingerprint_of(digests_of(files), folder)


def frames_of_files(
    folder: Path, files: Sequence[Path], sequence: FrameSequence, required: Sequence[int]
) -> tuple[dict[int, Path], str]:
    """The file of each frame that has one, and the rule that says so. InputError where a required frame has no file, or
    a file belongs to no frame: it would then count frames otherwise.
    """
    names = [file.name for file in files]
    match = match_names(folder, names, range(len(sequence)), sequence.image_names, required=required)
    if unused := len(files) - len(match.files):
        left = next(name for i, name in enumerate(names) if i not in match.files.values())
        got = f"{unused} of {len(files)} files of no frame, such as {left}"
        raise input_error(folder, f"files of the {len(sequence)} frames", got, HINT)
    return {index: files[position] for index, position in match.files.items()}, match.rule


def _matched(
    folder: Path, suffixes: tuple[str, ...], sequence: FrameSequence, split: Split
) -> tuple[dict[int, Path], str]:
    if (kind := kind_of(folder)) != "a folder":
        raise input_error(folder, "a folder of rendered frames", kind, "correct the path.")
    files = files_with(folder, suffixes)
    kinds = "/".join(suffix[1:].upper() for suffix in suffixes)
    if not files:
        holders = [sub for sub in sorted(entries(folder)) if sub.is_dir() and files_with(sub, suffixes)]
        usual = "depth" if ".npy" in suffixes else "rgb"  # as `endoprior render` calls them
        named = next((sub for sub in holders if sub.name == usual), holders[0] if holders else None)
        fix = f"pass {named}." if named else "pass the folder that holds the files themselves."
        raise input_error(folder, f"{kinds} files", "none", fix)
    return frames_of_files(folder, files, sequence, sequence.indices(split))


def _read_color(file: Path, camera: Camera) -> NDArray[np.float32]:
    """(H, W, 3) in [0, 1]."""
    pixels = decode_image(file, None)
    full = FULL_SCALE.get(pixels.dtype)
    opaque = pixels.ndim == 3 and (pixels.shape[2] == 3 or (pixels.shape[2] == 4 and (pixels[..., 3] == full).all()))
    if not full or not opaque:
        raise input_error(file, "an 8-bit or 16-bit RGB image", describe_pixels(pixels), "save it without alpha.")
    _demand_size(file, pixels, camera)
    return np.ascontiguousarray(pixels[..., 2::-1]).astype(np.float32) / np.float32(full)


def _read_depth(file: Path, scale: float | None, camera: Camera) -> NDArray[np.float32]:
    """(H, W) mm; 0 where nothing is."""
    if file.suffix.lower() == ".png":
        pixels = single_channel(file, decode_image(file, None))
        if pixels.dtype != np.uint16:
            raise input_error(file, "16-bit depth", describe_pixels(pixels), "save depth with 16 bits.")
        depth = pixels.astype(np.float32) * np.float32(scale)
    else:
        depth = read_depth_file(file, scale or 1.0)
    _demand_size(file, depth, camera)
    return depth


def _demand_size(file: Path, pixels: NDArray, camera: Camera) -> None:
    if pixels.shape[:2] != (camera.height, camera.width):
        want = f"{camera.width}x{camera.height} px like the frames of the sequence"
        raise input_error(file, want, f"{pixels.shape[1]}x{pixels.shape[0]}", "render at the size of the sequence.")
