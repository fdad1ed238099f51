"""Folders that hold more than one file per frame: images with their masks beside them, or each image twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..core.checks import input_error
from .file_names import DEPTH_WORDS, MASK_WORDS, OTHER_WORDS, bare, numbers_of, pattern_of, words_of

Kind = Literal["images", "masks", "depth"]


@dataclass(frozen=True)
class Series:
    """Files whose names differ in numbers only."""

    name: str
    """As the files are called, with # in place of a number: `frame_#_mask.png`."""
    files: tuple[Path, ...]

    def is_kind(self, kind: Kind) -> bool:
        """Whether its name says that it holds masks, or depth; or, for images, that it holds nothing else."""
        words = words_of(Path(self.name).stem)
        if kind == "images":
            return not words & (MASK_WORDS | DEPTH_WORDS | OTHER_WORDS)
        return bool(words & (MASK_WORDS if kind == "masks" else DEPTH_WORDS))

    def shows_frames_of(self, other: Series) -> bool:
        """Whether both have files of the same frames: most numbers of one are also in the other."""
        if min(len(self.files), len(other.files)) == 1:
            return bool({bare(file.stem) for file in self.files} & {bare(file.stem) for file in other.files})
        numbers = [set(numbers_of([file.stem for file in each.files]) or ()) for each in (self, other)]
        fewer = min(len(each) for each in numbers)
        return bool(fewer) and len(numbers[0] & numbers[1]) > fewer / 2


def series_of(files: Sequence[Path]) -> list[Series]:
    """The series among the files of a folder, in order of their first file."""
    found: dict[str, list[Path]] = {}
    for file in files:
        found.setdefault(pattern_of(file.stem) + file.suffix.lower(), []).append(file)
    return [Series(name, tuple(each)) for name, each in found.items()]


def one_per_frame(folder: Path, files: Sequence[Path], kind: Kind) -> tuple[list[Path], str]:
    """The files of one kind, where a folder has several files of a frame.

    Args:
        folder: for messages.
        files: in order.
        kind: what is looked for.
    Returns:
        The files in the same order, and a note on those left out; all files and no note where no frame has two.
    Raises:
        InputError: the names do not tell which series is meant.
    """
    every = series_of(files)
    if not _overlap(every):
        return list(files), ""
    wanted = [series for series in every if series.is_kind(kind)]
    if not wanted or _overlap(wanted):
        found = ", ".join(f"{series.name} ({len(series.files)})" for series in every[:6])
        more = f" and {len(every) - 6} more" if len(every) > 6 else ""
        fix = "put one of them into a folder of its own, and pass that."
        raise input_error(folder, f"one series of {kind}, one file per frame", found + more, fix)
    kept = {file for series in wanted for file in series.files}
    out = ", ".join(f"{series.name} ({len(series.files)})" for series in every if series not in wanted)
    return [
        file for file in files if file in kept
    ], f"{folder}: {len(kept)} of {len(files)} files are {kind}; not {out}"


def _overlap(series: Sequence[Series]) -> bool:
    """Whether two series have files of the same frames."""
    several = [each for each in series if len(each.files) > 1]
    if any(a.shows_frames_of(b) for i, a in enumerate(several) for b in several[:i]):
        return True
    names = [bare(file.stem) for each in series if len(each.files) == 1 for file in each.files]
    names += sorted({bare(file.stem) for each in several for file in each.files})
    return len(set(names)) < len(names)
