"""Which frame an image file shows, by the names of all files in its folder. Pure functions."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

NUMBER = re.compile(r"([^0-9]*)([0-9]+)([^0-9]*)")
"""A name with one number in it."""
OWN_NAMES = "the names of the sequence's own images"
NUMBERS = "frame numbers in the names, counted from 0"
IN_ORDER = "one file for each frame of the split, in order"
IN_ORDER_ALL = "one file for each frame of the sequence, in order"


@dataclass(frozen=True)
class Match:
    """The frame of each file, and the rule that says so."""

    rule: str
    frames: tuple[int, ...]
    """Frame index of each file."""


def match_names(stems: Sequence[str], own: Sequence[str], split: Sequence[int], total: int) -> Match | str:
    """Find the rule by which files are frames: own names, then frame numbers, then their order.

    A rule fits if it gives every file a frame of its own and every frame of the split a file.

    Args:
        stems: names of the files without suffix, in natural order.
        own: names of the sequence's own images, one for each frame; empty if it has none.
        split: indices of the frames that must be there.
        total: frames of the sequence.
    Returns:
        The first rule that fits; or, if none does or two rules disagree, what was found instead, as text.
    """
    candidates = [
        (OWN_NAMES, _by_own_names(stems, own)),
        (NUMBERS, _by_number(stems, total)),
        (IN_ORDER, list(split) if len(stems) == len(split) else None),
        (IN_ORDER_ALL, list(range(total)) if len(stems) == total else None),
    ]
    named = [Match(rule, tuple(frames)) for rule, frames in candidates[:2] if _fits(frames, split)]
    if len({match.frames for match in named}) > 1:
        return f"{len(stems)} names that are both {OWN_NAMES} and {NUMBERS}, for different frames"
    ordered = [Match(rule, tuple(frames)) for rule, frames in candidates[2:] if _fits(frames, split)]
    return next(iter(named + ordered), f"{len(stems)} files, {stems[0]!r} to {stems[-1]!r}")


def _fits(frames: list[int] | None, split: Sequence[int]) -> bool:
    return frames is not None and len(set(frames)) == len(frames) and set(split) <= set(frames)


def _by_own_names(stems: Sequence[str], own: Sequence[str]) -> list[int] | None:
    index = {name: i for i, name in enumerate(own)}
    return [index[stem] for stem in stems] if len(index) == len(own) and set(stems) <= set(index) else None


def _by_number(stems: Sequence[str], total: int) -> list[int] | None:
    """The number in each name, if every name has one and they are alike otherwise."""
    found = [NUMBER.fullmatch(stem) for stem in stems]
    if not all(found) or len({(match[1], match[3]) for match in found}) != 1:
        return None
    numbers = [int(match[2]) for match in found]
    return numbers if max(numbers) < total else None
