"""A folder of a user's images before `prepare`: the images in it or in a folder of it, and the masks beside them.

Folders are told by the words of their names, as files are: `images/` and `masks/`, or `frames/` and `labels/`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ..core.checks import input_error
from ..core.shell import command, quoted
from .description import read_description
from .files import DEPTH_WORDS, MASK_WORDS, OTHER_WORDS, entries, in_order, words_of
from .images import DEPTH_SUFFIXES
from .poses import MATRIX_FILE
from .reading import kind_of
from .video_files import STILL_SUFFIXES

IMAGES, MASKS = "images", "masks"  # names of folders that win over others


@dataclass(frozen=True)
class FolderContents:
    """What of a folder becomes a sequence."""

    images: Path  # the folder itself, or one in it
    mask_folders: tuple[Path, ...]  # beside the images, or in their folder
    calibration: Path | None  # a file of the plain layout with the lens
    frames_per_second: float | None  # as `sequence.json` says, 1/s

    @property
    def masks(self) -> Path | None:
        """The folder of masks, if there is one; InputError if there are several that may be it."""
        if len(self.mask_folders) < 2:
            return next(iter(self.mask_folders), None)
        got, first = ", ".join(each.name for each in self.mask_folders), self.mask_folders[0]
        fix = f"`--masks {quoted(first)}`, or the one of them that marks tools."
        raise input_error(first.parent, "one folder of masks", got, fix)


def contents_of(folder: Path) -> FolderContents | None:
    """Which images and masks of a folder belong together; None if it has no images, or several folders of them."""
    if kind_of(folder) != "a folder":
        return None
    images = folder if _has(folder, STILL_SUFFIXES, 2) else _images_in(folder)
    if images is None:
        return None
    masks = [each for each in _folders(folder) if _is_of(each, MASK_WORDS) and any(_visible(each))]
    usual = [each for each in masks if each.name.lower() == MASKS]
    described = read_description(folder / "sequence.json")
    lens = folder / ("sequence.json" if "fx" in described else MATRIX_FILE)
    rate = described.get("frames_per_second")
    return FolderContents(
        images, tuple(usual or masks), lens if lens.is_file() else None, None if rate is None else float(rate)
    )


def image_folders(folder: Path) -> list[Path]:
    """The folders in a folder that hold images, and no masks, depth or pictures of something else."""
    others = MASK_WORDS | DEPTH_WORDS | OTHER_WORDS
    return [each for each in _folders(folder) if not _is_of(each, others) and _has(each, STILL_SUFFIXES, 2)]


def is_footage(folder: Path) -> bool:
    """Whether `prepare` takes a folder and loses nothing by it: it has images, and no folder of depth."""
    return contents_of(folder) is not None and not any(_is_of(each, DEPTH_WORDS) for each in _folders(folder))


def how_to_add_depth(folder: Path, *, is_plain: bool) -> str:
    """What gives depth to a sequence folder that has none anywhere; `is_plain`: of the layout `plain`."""
    if is_plain and not has_depth(folder):
        return f"{ways_to_prepare(folder)}."
    if has_depth(folder):
        return "provide depth in mm, 0 where it is missing."
    return f"run `prepare` without `--depth none`; `{command('check', folder)}` has the details."


def has_depth(folder: Path) -> bool:
    """Whether there are files of depth in a sequence folder."""
    return (folder / "depth").is_dir() and _has(folder / "depth", DEPTH_SUFFIXES)


def beside(path: Path, ending: str) -> Path:
    """A path beside a video or folder, named after it: `clip_data` for `clip.mp4`."""
    whole = path if path.name not in ("", "..") else Path(os.path.abspath(path))
    return whole.with_name(f"{whole.stem if whole.is_file() else whole.name}_{ending}")


def ways_to_prepare(path: Path, *options: str | Path) -> str:
    """The commands that make a sequence folder of a video or a folder of images, or do every step."""
    data = beside(path, "data")
    every_step = command("run", path, beside(path, "out"), *options)
    return f"`{command('prepare', path, data, *options)}`, then `{command('check', data)}`; every step: `{every_step}`"


def _folders(folder: Path) -> list[Path]:
    return in_order(each for each in entries(folder) if each.is_dir() and not each.name.startswith("."))


def _images_in(folder: Path) -> Path | None:
    """The folder of the usual name, else the only one with images; None if there is none, or several."""
    found = image_folders(folder)
    named = [each for each in found if each.name.lower() == IMAGES]
    return (named or found)[0] if len(named or found) == 1 else None


def _is_of(folder: Path, words: set[str]) -> bool:
    return bool(words_of(folder.name) & words)


def _has(folder: Path, suffixes: Iterable[str], least: int = 1) -> bool:
    return sum(file.suffix.lower() in suffixes for file in _visible(folder)) >= least


def _visible(folder: Path) -> list[Path]:
    try:
        return [each for each in folder.iterdir() if each.name[0] != "."]
    except OSError:  # not readable
        return []
