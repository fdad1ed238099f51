"""What the names of the files in a folder say: their order, their numbers, what they show. Pure functions of names."""

from __future__ import annotations

import re
from collections.abc import Sequence

NUMBER = re.compile(r"[0-9]+")
DECIMAL = re.compile(r"[0-9]+(?:\.[0-9]+)?")
MASK_WORDS = {
    "mask", "masks", "msk", "seg", "segm", "segmentation", "label", "labels", "annotation", "annotations", "watershed",
    "instance", "instances", "semantic", "binary", "gt", "groundtruth", "ids", "matte",
}  # fmt: skip
"""A file with one of these words in its name is a mask."""
DEPTH_WORDS = {"depth", "depths", "disp", "disparity", "z"}
"""A file with one of these words in its name is a depth map."""
OTHER_WORDS = {"normal", "normals", "flow", "occlusion", "overlay", "confidence", "uncertainty", "visualization", "vis"}
"""A file with one of these words in its name is no frame either."""


def words_of(stem: str) -> set[str]:
    """The words of a name, in lower case: `frame` and `ids` of `frame_80Ids`."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", stem)}


def bare(stem: str) -> str:
    """A name without the words that say what its file shows, and what separates them."""
    roles = MASK_WORDS | DEPTH_WORDS | OTHER_WORDS
    parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+|[0-9]+|[^\W_a-zA-Z0-9]+", stem)  # and letters of other scripts
    return "_".join(part.lower() for part in parts if part.lower() not in roles)


def sorting_keys(stems: Sequence[str]) -> list[list[int | str] | tuple[str, float, str]]:
    """A key for each name, for the natural order: runs of digits are numbers, 2 before 10.

    Where the last numbers are decimals, as times in seconds are, they compare as such: 0.04 before 0.2.
    """
    if _are_decimals(stems):
        found = [list(DECIMAL.finditer(stem))[-1] for stem in stems]
        pairs = zip(stems, found, strict=True)
        return [(stem[: match.start()], float(match[0]), stem[match.end() :]) for stem, match in pairs]
    # Splitting at digits alternates text and number, so that equal positions always compare.
    split = [re.split(r"([0-9]+)", stem) for stem in stems]
    return [[int(part) if i % 2 else part for i, part in enumerate(parts)] for parts in split]


def numbers_of(stems: Sequence[str]) -> list[float] | None:
    """The number of each name, all different: the last run of digits that differs; a time in seconds as sorted.

    Returns:
        None if a name has no number, or no run of digits tells the names apart.
    """
    if _are_decimals(stems):
        columns = [[float(DECIMAL.findall(stem)[-1]) for stem in stems]]
    else:
        rows = [[int(digits) for digits in NUMBER.findall(stem)] for stem in stems]
        if not all(rows):
            return None
        even = len({len(row) for row in rows}) == 1
        columns = list(zip(*rows, strict=True))[::-1] if even else [[row[-1] for row in rows]]
    return next(([float(number) for number in column] for column in columns if len(set(column)) == len(column)), None)


def pattern_of(stem: str) -> str:
    """A name with `#` in place of each number, the same for all files of a series."""
    return DECIMAL.sub("#", stem)


def _are_decimals(stems: Sequence[str]) -> bool:
    """Whether the last numbers are decimals: as many digits behind each point say nothing, and 1.10 follows 1.9."""
    found = [DECIMAL.findall(stem) for stem in stems]
    if not all(found):
        return False
    fractions = [numbers[-1].partition(".")[2] for numbers in found]
    ends = any(len(fraction) > 1 and fraction.endswith("0") for fraction in fractions)
    return len({len(fraction) for fraction in fractions}) > 1 and not ends
