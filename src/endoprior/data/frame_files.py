"""Which file belongs to which frame: by names, by the numbers in them, or in order. Every pairing is done here.

Numbers come first: as many files as frames may still be of other frames, if one is missing and one is too many. Order
is used only where the numbers agree with it, or where there are none. A folder may also hold more than one file per
frame: images with their masks beside them, or each image twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..core.checks import input_error
from .files import DEPTH_WORDS, MASK_WORDS, OTHER_WORDS, bare, files_with, numbers_of, patterns_of, words_of

Kind = Literal["images", "masks", "depth"]
HINT = "Add the missing files, or name each file by its frame number."
GAP = 1.5  # numbers are missing where two files are further apart than so many times the usual step
BY_NAME, BY_NUMBER = "matched by name", "matched by the numbers in the names"
COUNTED = "matched in order, their numbers are counted otherwise"


@dataclass(frozen=True)
class Series:
    """Files whose names differ in numbers only."""

    name: str  # as the files are called, with # in place of a number: `frame_#_mask.png`
    files: tuple[Path, ...]

    def __str__(self) -> str:
        return f"{self.name} ({len(self.files)})"

    def is_kind(self, kind: Kind) -> bool:
        """Whether its name says that it holds masks, or depth; or, for images, that it holds nothing else."""
        words = words_of(Path(self.name).stem)
        if kind == "images":
            return not words & (MASK_WORDS | DEPTH_WORDS | OTHER_WORDS)
        return bool(words & (MASK_WORDS if kind == "masks" else DEPTH_WORDS))

    def shows_frames_of(self, other: Series) -> bool:
        """Whether most numbers of one are also in the other; both have several files."""
        numbers = [set(numbers_of([file.stem for file in each.files]) or ()) for each in (self, other)]
        fewer = min(len(each) for each in numbers)
        return bool(fewer) and len(numbers[0] & numbers[1]) > fewer / 2


def one_per_frame(folder: Path, files: Sequence[Path], kind: Kind) -> tuple[list[Path], str]:
    """The files of one kind where a folder has several of a frame, else all; and a note on those left out, or none."""
    found: dict[str, list[Path]] = {}
    for file, pattern in zip(files, patterns_of([file.stem for file in files]), strict=True):
        found.setdefault(pattern + file.suffix.lower(), []).append(file)
    every = [Series(name, tuple(each)) for name, each in found.items()]
    if not _overlap(every):
        return list(files), ""
    wanted = [series for series in every if series.is_kind(kind)]
    if not wanted or _overlap(wanted):
        more = f" and {len(every) - 6} more" if len(every) > 6 else ""
        fix = "put one of them into a folder of its own, and pass that."
        raise input_error(
            folder, f"one series of {kind}, one file per frame", ", ".join(map(str, every[:6])) + more, fix
        )
    kept = {file for series in wanted for file in series.files}
    out = ", ".join(str(series) for series in every if series not in wanted)
    note = f"{folder}: {len(kept)} of {len(files)} files are {kind}; not {out}"
    return [file for file in files if file in kept], note


def missing_numbers(files: Sequence[Path]) -> str:
    """A note on numbers that a series of files, in order, leaves out, or none: time passes there without an image.

    The usual step may be any, as in every fifth frame. Times as names, which are a little uneven, leave out nothing.
    """
    numbers = numbers_of([file.stem for file in files])
    steps = np.diff(numbers or [])
    if not len(steps) or steps.min() <= 0:
        return ""
    usual = float(np.percentile(steps, 50, method="lower"))
    gaps = np.flatnonzero(steps > GAP * usual)
    if not len(gaps):
        return ""
    count, (before, after) = int(np.round(steps[gaps] / usual - 1).sum()), files[gaps[0] : gaps[0] + 2]
    more = f", and in {len(gaps) - 1} more places" if len(gaps) > 1 else ""
    where = f"between {before.name} and {after.name}{more}"
    return f"{count} numbers are missing, {where}; the files count as evenly spaced in time"


def _overlap(series: Sequence[Series]) -> bool:
    """Whether two series have files of the same frames."""
    every = [file.name.casefold() for each in series for file in each.files]
    several = [each for each in series if len(each.files) > 1]
    if len(set(every)) < len(every):
        return True
    if any(a.shows_frames_of(b) for i, a in enumerate(several) for b in several[:i]):
        return True
    names = [bare(file.stem) for each in series if len(each.files) == 1 for file in each.files]
    names += {bare(file.stem) for each in several for file in each.files}
    return len(set(names)) < len(names)


@dataclass(frozen=True)
class Matched:
    """Which file belongs to which frame."""

    files: dict[int, int]  # position among the files, for each selected position in the source
    rule: str  # how it was found, for a note: `matched by name`


def match_files(
    folder: Path, suffixes: Sequence[str], what: Kind, indices: Sequence[int], names: Sequence[str] = ()
) -> tuple[dict[int, Path], list[str]]:
    """The file in `folder` of each selected frame, and notes; as `match_names`. `what` tells one of several series."""
    if not folder.is_dir():
        got = "a file" if folder.exists() else "no such folder"
        raise input_error(folder, f"a folder of {what}", got, "Pass the folder that holds one file per frame.")
    files = files_with(folder, tuple(suffixes))
    if not files:
        raise input_error(folder, f"{what} ({', '.join(suffixes)})", "none", "Put one file per frame there.")
    files, note = one_per_frame(folder, files, what)
    matched = match_names(folder, [file.name for file in files], indices, names)
    notes = [note] if note else []
    return {index: files[position] for index, position in matched.files.items()}, [*notes, f"{what}: {matched.rule}"]


def files_of_images(
    folder: Path, files: Sequence[Path], kind: Kind, images: Sequence[Path], remarks: list[str]
) -> dict[int, Path]:
    """The file of each image that has one, by position of the image; files, in order, of another kind are left out.

    `remarks` gets where order decides, and the numbers of images without a file and of files without an image.
    """
    files, note = one_per_frame(folder, files, kind)
    names = [image.stem for image in images]
    matched = match_names(folder, [file.name for file in files], range(len(images)), names, required=())
    remarks += [note] if note else []
    remarks += [f"{folder}: {matched.rule}"] if "in order" in matched.rule else []
    if without := len(images) - len(matched.files):
        remarks.append(f"{folder}: {without} of {len(images)} images have no file there and are left out")
    if unused := len(files) - len(matched.files):
        remarks.append(f"{folder}: {unused} files of other frames are not used")
    return {index: files[position] for index, position in matched.files.items()}


def match_names(
    folder: Path,
    files: Sequence[str],
    indices: Sequence[int],
    names: Sequence[str] = (),
    *,
    required: Sequence[int] | None = None,
    in_order_only: bool = False,
) -> Matched:
    """The file of each selected frame of the source.

    Files belong to the images of their name or number, else to positions in the source, counted from 0 or from 1. With
    as many files as images or as selected frames, they are taken in order if their numbers do not contradict.

    Args:
        folder: for messages.
        files: file names in natural order.
        indices: positions of the selected frames in the source, ascending.
        names: of all images of a source folder, without suffixes; empty for a video.
        required: those of `indices` that must have a file, while others may have none; None: all of them.
        in_order_only: the numbers in the names of the files say nothing about frames.
    """
    given = _Names(files, names)
    if in_order_only:
        if by_name := given.by_name(indices):
            return Matched(by_name, BY_NAME)
        if matched := _in_order(files, names, indices, "their numbers are not those of frames"):
            return matched
        hint = "Export one for each frame, or name each file by its frame number."
        got = f"{len(files)} tasks for {len(required or indices)} frames"
        raise input_error(folder, "masks of as many tasks as frames", got, hint)
    matched = given.of_all(indices)
    if matched is None and required is not None:
        matched = given.of_some(folder, indices, required)
        if matched is None and required:
            matched = given.of_all(required)
    if matched is not None:
        return matched
    wanted, numbers = required or indices, given.numbers
    counts = f"{len(files)} files for {len(wanted)} frames"
    if numbers is None:
        want = "one file per frame, or a number of its own in each name"
        raise input_error(folder, want, f"{counts}, such as {files[0]} and {files[-1]}", HINT)
    missing = [f"{number:g}" for number in given.wanted(wanted) if number not in numbers]
    some = ", ".join(missing[:4]) + (f" and {len(missing) - 4} more" if len(missing) > 4 else "")
    raise input_error(folder, "one file per frame", f"{counts}, none numbered {some}", HINT)


def _in_order(files: Sequence[str], names: Sequence[str], indices: Sequence[int], why: str) -> Matched | None:
    """As many files as selected frames or as images, one for each."""
    if len(files) == len(indices):
        return Matched(dict(zip(indices, range(len(files)), strict=True)), f"matched in order, {why}")
    return Matched({i: i for i in indices}, f"matched in order, {why}") if len(files) == len(names) else None


class _Names:
    """The names of some files and of the images that they may belong to, and the rules that find one for the other."""

    def __init__(self, files: Sequence[str], names: Sequence[str]) -> None:
        self.files, self.names = files, names
        self.stems = [Path(file).stem for file in files]
        self.numbers = numbers_of(self.stems)  # of each file; None if the names do not tell
        self.own = numbers_of(names) if names else None  # of each image; None for a video

    def of_all(self, indices: Sequence[int]) -> Matched | None:
        """A file for every frame; None where the names do not give one to each."""
        numbers = self.numbers
        if numbers is None:
            if by_name := self.by_name(indices):
                return Matched(by_name, BY_NAME)
            return _in_order(self.files, self.names, indices, "each has no number of its own")
        if by_name := self.by_name(range(len(self.names))):
            return Matched({index: by_name[index] for index in indices}, BY_NAME)
        if self.own is not None and (matched := self._of_images(indices, numbers, self.own)):
            return matched
        wanted = self.wanted(indices)
        if {*wanted} <= {*numbers}:
            found = _places(numbers, indices, wanted)
            return Matched(found, BY_NUMBER if self.own is not None else self._rule_of_positions(found))
        chosen = wanted if self.own is not None else list(map(float, indices))
        if len(self.files) == len(indices) and _agree(numbers, chosen):
            shown = f"image {self.names[indices[0]]}" if self.names else f"frame {indices[0]}"
            in_order = dict(zip(indices, range(len(self.files)), strict=True))
            return Matched(in_order, f"{COUNTED}: {self.files[0]} for {shown}")
        return None

    def _of_images(self, indices: Sequence[int], numbers: list[float], own: list[float]) -> Matched | None:
        if {*own} <= {*numbers}:
            return Matched(_places(numbers, indices, [own[index] for index in indices]), BY_NUMBER)
        if len(self.files) == len(self.names) and _agree(numbers, own):
            return Matched({i: i for i in indices}, f"{COUNTED}: {self.files[0]} for image {self.names[0]}")
        by_name = self.by_name(indices)
        return Matched(by_name, BY_NAME) if by_name else None

    def of_some(self, folder: Path, indices: Sequence[int], required: Sequence[int]) -> Matched | None:
        """The rule that finds a file for most frames and all that are required; None if there is no such rule."""
        names, numbers, own = self.names, self.numbers, self.own
        found = [Matched(self._named(form, indices), BY_NAME) for form in ((str, bare) if names else ())]
        if numbers is not None:
            if own is not None:
                here, before, after = (len({own[i] + by for i in indices} & {*numbers}) for by in (0, -1, 1))
                if here >= max(before, after):  # else they are counted otherwise, and some are missing
                    found.append(Matched(_places(numbers, indices, [own[i] for i in indices]), BY_NUMBER))
            for first in self._starts(indices) if required or not names else ():
                by_position = _places(numbers, indices, [index + first for index in indices])
                found.append(Matched(by_position, self._rule_of_positions(by_position)))
        fitting = [each for each in found if each.files and {*required} <= each.files.keys()]
        if required and names and any(each.files != fitting[0].files for each in fitting):
            got = f"{len(self.files)} names that are those of the images and also numbers of other frames"
            raise input_error(folder, "names that tell the frames", got, "Name each file by its frame, counted from 0.")
        return max(fitting, key=lambda each: len(each.files), default=None)

    def wanted(self, indices: Sequence[int]) -> list[float]:
        """The number that the file of each frame should have."""
        if self.own is not None:
            return [self.own[index] for index in indices]
        first = self._starts(indices)[0]
        return [float(index + first) for index in indices]

    def by_name(self, indices: Sequence[int]) -> dict[int, int] | None:
        """The file called like each image, whatever its words for mask or depth; None if not each has one."""
        found = (self._named(form, indices) for form in ((str, bare) if self.names else ()))
        return next((each for each in found if each and len(each) == len(indices)), None)

    def _named(self, form: Callable[[str], str], indices: Sequence[int]) -> dict[int, int]:
        return _places([form(stem) for stem in self.stems], indices, [form(self.names[index]) for index in indices])

    def _starts(self, indices: Sequence[int]) -> tuple[int, int]:
        """Whether files of a video are counted from 0 or from 1: the likelier one first."""
        numbers = self.numbers or []
        from_zero, from_one = (len({index + first for index in indices} & {*numbers}) for first in (0, 1))
        # Names that begin at 1 are counted from 1; what begins later may be either.
        return (1, 0) if from_one > from_zero or (from_one == from_zero and min(numbers) == 1) else (0, 1)

    def _rule_of_positions(self, found: dict[int, int]) -> str:
        if not found or self.numbers is None:
            return ""
        index, numbers = min(found), self.numbers
        first = int(numbers[found[index]]) - index
        is_doubtful = first == 0 and min(numbers) > 1 and all(i + 1 in {*numbers} for i in found)
        doubt = "; if they are counted from 1, number them anew" if is_doubtful else ""
        return f"{BY_NUMBER}, counted from {first}: {self.files[found[index]]} for frame {index}{doubt}"


def _places(of_files: Sequence[Any], indices: Sequence[int], wanted: Sequence[Any]) -> dict[int, int]:
    """Position of the file of each frame that has one, by what is wanted for it; empty if frames share a file."""
    place = {value: position for position, value in enumerate(of_files)}
    found = {index: place[value] for index, value in zip(indices, wanted, strict=True) if value in place}
    return found if len({*found.values()}) == len(found) else {}


def _agree(numbers: Sequence[float], others: Sequence[float]) -> bool:
    """Whether numbers of files in order can belong to others, one for one: all as much apart, or only counted."""
    a, b = np.array(numbers), np.array(others)
    if len(a) != len(b) or (np.diff(a) <= 0).any() or (np.diff(b) <= 0).any():
        return False
    if np.ptp(a - b) == 0:
        return True
    counted = a[0] in (0, 1) and (np.diff(a) == 1).all()
    return bool(counted and (np.ptp(np.diff(b)) == 0 or not set(numbers) & set(others)))
