"""Files of a dataset folder: what their names say, their order, their fingerprint, and whether they changed."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path, PureWindowsPath
from string import ascii_lowercase, ascii_uppercase

from ..core.checks import input_error, similar_name
from ..core.shell import quoted
from .reading import ACCESS_HINT, reading

DECIMAL = re.compile(r"[0-9]+(?:\.[0-9]+)?")
LETTERED, ALPHABETS = re.compile("#[A-Za-z]$"), (ascii_lowercase, ascii_uppercase)
# What a file holds, by a word of its name: a mask, a depth map, or something else that is no frame.
MASK_WORDS = {
    "mask", "masks", "msk", "seg", "segm", "segmentation", "label", "labels", "annotation", "annotations", "watershed",
    "instance", "instances", "semantic", "binary", "gt", "groundtruth", "ids", "matte",
}  # fmt: skip
CONFIDENCE = "depth_confidence"  # folder with how surely the depth of each frame was measured, 8 bits
DEPTH_WORDS = {"depth", "depths", "disp", "disparity", "z"}
OTHER_WORDS = {"normal", "normals", "flow", "occlusion", "overlay", "confidence", "uncertainty", "visualization", "vis"}
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")  # of color images that readers accept
FileState = tuple[int, int, int] | None


def words_of(stem: str) -> set[str]:
    """The words of a name, in lower case: `frame` and `ids` of `frame_80Ids`."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", stem)}


def bare(stem: str) -> str:
    """A name without the words that say what its file shows, and what separates them."""
    roles = MASK_WORDS | DEPTH_WORDS | OTHER_WORDS
    parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+|[0-9]+|[^\W_a-zA-Z0-9]+", stem)  # and letters of other scripts
    return "_".join(part.lower() for part in parts if part.lower() not in roles)


def sorting_keys(stems: Sequence[str]) -> list[list[int | str] | tuple[str, float, str]]:
    """A key for each name, for the natural order: runs of digits are numbers, 2 before 10, and -2 before -1.

    Capitals do not count. Where the last numbers are decimals, as times in seconds are, they compare as such: 0.04
    before 0.2.
    """
    stems = _without_plus([stem.casefold() for stem in stems])
    below = _below_zero(stems)
    if _are_decimals(stems):
        parts = [_around_last(stem) for stem in stems]
        return [
            (head[:-1], -float(number), tail) if i in below else (head, float(number), tail)
            for i, (head, number, tail) in enumerate(parts)
        ]
    return [_split(stem, i in below) for i, stem in enumerate(stems)]


def numbers_of(stems: Sequence[str]) -> list[float] | None:
    """The number of each name: the last run of digits that differs in all, or a decimal; None if there is none."""
    if _are_decimals(stems):
        columns = [[float(key[1]) for key in sorting_keys(stems)]]
    else:
        rows = [[part for part in key if isinstance(part, int)] for key in sorting_keys(stems)]
        if not all(rows):
            return None
        even = len({len(row) for row in rows}) == 1
        columns = list(zip(*rows, strict=True))[::-1] if even else [[row[-1] for row in rows]]
    return next(([float(number) for number in column] for column in columns if len(set(column)) == len(column)), None)


def patterns_of(stems: Sequence[str]) -> list[str]:
    """Each name with `#` in place of each number, the same for all files of a series.

    A sign, and letters that count on within a number (1a, 1b, 2a), belong to the number.
    """
    stems = _without_plus(stems)
    below = _below_zero(stems)
    patterns = [DECIMAL.sub("#", stem) for stem in stems]
    patterns = ["#".join(p.rsplit("-#", 1)) if i in below else p for i, p in enumerate(patterns)]
    letters: dict[str, set[str]] = {}
    for pattern in patterns:
        if LETTERED.search(pattern):
            letters.setdefault(pattern[:-1], set()).add(pattern[-1])
    counting = {before for before, found in letters.items() if _count_on(found)}
    return [pattern[:-1] if LETTERED.search(pattern) and pattern[:-1] in counting else pattern for pattern in patterns]


def _count_on(letters: set[str]) -> bool:
    """Whether letters are the first ones of the alphabet, at least a and b: not L and R."""
    return len(letters) > 1 and any("".join(sorted(letters)) == all_of[: len(letters)] for all_of in ALPHABETS)


def _around_last(stem: str) -> tuple[str, str, str]:
    """What stands before the last number of a name, which may be a decimal; the number; what stands behind it."""
    number = list(DECIMAL.finditer(stem))[-1]
    return stem[: number.start()], number[0], stem[number.end() :]


def _split(stem: str, is_below: bool) -> list[int | str]:
    """Text and numbers in turn, so that equal positions always compare; the sign of the last number is in it."""
    if not is_below:
        return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", stem))]
    head, number, tail = _around_last(stem)
    negative = [-part if isinstance(part, int) else part for part in _split(number + tail, False)]
    return [*_split(head[:-1], False), *negative[1:]]


def _without_plus(stems: Sequence[str]) -> list[str]:
    """The names without the sign of numbers above 0, where others of the series have that of numbers below: -1, +1."""
    parts = [_around_last(stem) if DECIMAL.search(stem) else (stem, "", "") for stem in stems]
    signed = {(head[:-1], tail) for head, _, tail in parts if head.endswith("-")}
    return [
        head[:-1] + number + tail if head.endswith("+") and (head[:-1], tail) in signed else stem
        for stem, (head, number, tail) in zip(stems, parts, strict=True)
    ]


def _below_zero(stems: Sequence[str]) -> set[int]:
    """Positions of the names whose last number is below 0.

    A hyphen before it is a sign, and no separator, where other names go on from 0 without it: -2, -1, 0, 1.
    """
    series: dict[tuple[str, str], tuple[dict[int, float], dict[int, float]]] = {}
    for i, stem in enumerate(stems):
        if DECIMAL.search(stem):
            head, number, tail = _around_last(stem)
            with_hyphen = head.endswith("-")
            series.setdefault((head.removesuffix("-"), tail), ({}, {}))[with_hyphen][i] = float(number)
    return {i for above, below in series.values() if _goes_on(above.values(), below.values()) for i in below}


def _goes_on(above: Collection[float], below: Collection[float]) -> bool:
    """Whether numbers from 0 on continue others, given without their sign, as evenly as these follow each other."""
    if not above or not below or 0 in below:
        return False
    steps = [b - a for part in (above, below) for a, b in pairwise(sorted({*part}))]
    return 0 in above or (bool(steps) and min(above) + min(below) <= max(steps) + 1e-9)


def _are_decimals(stems: Sequence[str]) -> bool:
    """Whether the last numbers are decimals: as many digits behind each point say nothing, and 1.10 follows 1.9."""
    found = [DECIMAL.findall(stem) for stem in stems]
    if not all(found):
        return False
    fractions = [numbers[-1].partition(".")[2] for numbers in found]
    ends = any(len(fraction) > 1 and fraction.endswith("0") for fraction in fractions)
    return len({len(fraction) for fraction in fractions}) > 1 and not ends


def entries(folder: Path) -> list[Path]:
    """The entries of a folder, unordered."""
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise input_error(folder, "a readable folder", error.strerror or str(error), ACCESS_HINT) from None


def or_neighbor(fix: str, path: Path) -> str:
    """A fix, with its period, and the entry beside a path that is not there whose name is most similar, if any."""
    try:
        names = [entry.name for entry in path.parent.iterdir()]
    except OSError:
        return fix
    same = [name for name in names if name.lower() == path.name.lower()]
    nearest = next(iter(same), None) or similar_name(path.name, names)
    return f"{fix} Did you mean `{quoted(path.with_name(nearest))}`?" if nearest else fix


def in_order(files: Iterable[Path]) -> list[Path]:
    """The files of a folder in natural order of their names: 2 before 10, and 0.04 before 0.2 where they are times."""
    listed = list(files)
    keys = sorting_keys([file.stem for file in listed])
    return [listed[i] for i in sorted(range(len(listed)), key=lambda i: (keys[i], listed[i].suffix, listed[i].name))]


def files_with(folder: Path, suffixes: tuple[str, ...], ending: str = "") -> list[Path]:
    """The entries with one of the suffixes, in lower case, and such a stem, in natural order; hidden ones left out."""
    return in_order(
        file
        for file in entries(folder)
        if file.suffix.lower() in suffixes and file.stem.endswith(ending) and not file.name.startswith(".")
    )


def list_files(folder: Path, suffixes: tuple[str, ...], layout: str, ending: str = "") -> list[Path]:
    """As `files_with`; InputError if there are none. `layout` is the name of the expected layout."""
    kind = "/".join(sorted({suffix.removeprefix(".").upper() for suffix in suffixes} - {"JPEG", "TIF"}, reverse=True))
    if not folder.is_dir():
        fix = f"pass a folder in the {layout} layout."
        raise input_error(folder, f"a folder of {kind} files", "no such folder", fix)
    if files := files_with(folder, suffixes, ending):
        return files
    other = sorted({file.suffix for file in entries(folder) if file.suffix and not file.name.startswith(".")})
    got = f"none (only {', '.join(other)})" if other else "none"
    raise input_error(folder, f"{kind} files", got, f"put one {kind} per frame there.")


def portable(name: str) -> str:
    """A relative path that a file names, with / between its parts: programs on Windows write a backslash."""
    return name.replace("\\", "/")


def named_file(folder: Path, name: str) -> Path:
    """The file below a folder that another file names. Elsewhere than on Windows, a name may hold a backslash."""
    literal = folder / name
    return literal if "\\" not in name or literal.exists() else folder / portable(name)


def file_below(folder: Path, name: str, source: Path) -> Path:
    """As `named_file`; InputError about `source`, which names the file, for an absolute path to another folder."""
    found = named_file(folder, name)
    if PureWindowsPath(name).drive or not found.is_relative_to(folder):
        raise input_error(source, "paths from its folder", name[:80], "write paths relative to the file.")
    return found


def state_of(file: Path) -> FileState:
    """What changes with the contents of a file, without reading them; None if there is no such file."""
    try:
        facts = file.stat()
    except OSError:
        return None
    return facts.st_mtime_ns, facts.st_ctime_ns, facts.st_size


def demand_same(files: Sequence[Path], states: Sequence[FileState], before: Sequence[FileState]) -> None:
    """Raise InputError if the state of a file is not what it was before."""
    for file, now, then in zip(files, states, before, strict=True):
        if now != then:
            fix = "Put the data back and resume, or train on the new data in a new folder."
            raise input_error(file, "data that stays as it is during training", "a file that was changed", fix)


def digests_of(files: Iterable[Path]) -> dict[Path, bytes]:
    """SHA-256 of the contents of each file; each is read once, in order."""
    digests = dict[Path, bytes]()
    for file in sorted({*files}):
        with reading(file), file.open("rb") as content:
            digests[file] = hashlib.file_digest(content, "sha256").digest()
    return digests


def fingerprint_of(digests: Mapping[Path, bytes], folder: Path) -> str:
    """SHA-256, in hex, of the names (below the folder) and the digests of files."""
    whole = hashlib.sha256()
    for file in sorted(digests):
        whole.update(os.fsencode(file.relative_to(folder).as_posix()) + b"\0" + digests[file])
    return whole.hexdigest()
