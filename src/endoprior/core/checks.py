"""Input checks, their error messages `FILE: expected X, got Y. Fix: COMMAND.`, and text that is safe to show."""

from __future__ import annotations

import difflib
import hashlib
import re
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any


def printable(text: str) -> str:
    r"""The text with `\x1b` and the like in place of characters that a terminal obeys or that turn the text around.

    Newlines, tabs and spaces of any width stay.
    """
    return text if text.isprintable() else "".join(map(_shown, text))


def quotation(text: str) -> str:
    """Text from a file or a name, without what would pass for advice of this program: backticks and `Fix:`."""
    return re.sub(r"\bfix\s*:", "fix", text.replace("`", "'"), flags=re.IGNORECASE)


def _shown(character: str) -> str:
    if character.isprintable() or character in "\n\t" or unicodedata.category(character) == "Zs":
        return character
    return character.encode("unicode_escape").decode("ascii")


class InputError(ValueError):
    """The user's data or options cannot be used. The command line prints it as one line and exits with status 2."""


def input_error(subject: Path | str, expected: str, got: str, fix: str) -> InputError:
    """The error for a file, folder or option that cannot be used: `SUBJECT: expected X, got Y. Fix: Z`.

    Args:
        subject: name of the file, folder or option.
        got: what was found. It may come from a file, so that nothing in it looks like a second `Fix`.
        fix: the command to run, in backticks, or one sentence; with its final period. It starts with a capital letter.
    """
    found = f"{quotation(str(subject))}: expected {expected}, got {quotation(got)}"
    return InputError(f"{found}. Fix: {fix[:1].upper()}{fix[1:]}")


def similar_name(name: str, names: Sequence[str]) -> str | None:
    """The name with the same last part, such as `temporal.weight` for `weight`, else the most similar one, or None."""
    last = [re.split(r"\.|--", each)[-1] for each in (name, *names)]
    same = [each for each, part in zip(names, last[1:], strict=True) if part == last[0]]
    return next(iter(same or difflib.get_close_matches(name.lower(), names, 1, 0.75)), None)


def or_did_you_mean(fix: str, name: str, names: Sequence[str], prefix: str = "") -> str:
    """A fix, with its period, and the name that a mistyped one is most similar to, as it is typed after `prefix`."""
    nearest = similar_name(name, names)
    return f"{fix} Did you mean `{prefix}{nearest}`?" if nearest else fix


def number_ranges(numbers: Iterable[int], most: int = 8) -> str:
    """Ascending numbers as text: 3, 4, 5, 9 give `3-5, 9`. Beyond `most` ranges, the rest is only counted."""
    ranges: list[list[int]] = []
    for number in numbers:
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    text = ", ".join(f"{first}" if first == last else f"{first}-{last}" for first, last in ranges[:most])
    return text + (f" and {len(ranges) - most} more" if len(ranges) > most else "")


def frame_list(frames: Collection[int]) -> str:
    """Ascending numbers of frames as text: `frames 3-5, 9`, or `frame 3`."""
    return f"frame{'' if len(frames) == 1 else 's'} {number_ranges(frames)}"


def read_ranges(name: str, text: str) -> frozenset[int]:
    """The numbers in a text such as `3-5,9`; the inverse of `number_ranges`.

    Args:
        name: what the error message calls the text.
    Raises:
        ValueError: the text has another form, or a number has more than 6 digits.
    """
    numbers: set[int] = set()
    for part in text.replace(" ", "").split(",") if text.strip() else []:
        if not (ends := re.fullmatch(r"([0-9]{1,6})(?:-([0-9]{1,6}))?", part)):
            raise ValueError(f"{name} must look like `3-5,9`, got {text[:80]!r}")
        numbers.update(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
    return frozenset(numbers)


def check_shape(spec: str, **arrays: Any) -> dict[str, int]:
    """Compare array shapes with a spec such as ``"means:N,3 quats:N,4"`` and return the size of each letter.

    Raises:
        ValueError: a shape differs from its spec, or one letter has two sizes.
    """
    sizes: dict[str, int] = {}
    for item in spec.split():
        name, dims = item.split(":")
        want, got = dims.split(","), tuple(arrays[name].shape)
        matches = len(want) == len(got) and all(
            (int(w) if w.isdigit() else sizes.setdefault(w, g)) == g for w, g in zip(want, got, strict=True)
        )
        if not matches:
            raise ValueError(f"{name} must have shape ({dims}), got {got}{f' with {sizes}' if sizes else ''}")
    return sizes


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise ValueError unless low <= value <= high (NaN fails)."""
    if not low <= value <= high:
        raise ValueError(f"{name} must be in [{low:g}, {high:g}], got {value!r}")


def shipped_file(file: Path, sha256: str, what: str) -> bytes:
    """The bytes of a file that comes with the program; InputError, which says `what` it is, if missing or changed."""
    fix = "install the program again."
    try:
        data = file.read_bytes()
    except OSError as error:
        raise input_error(file, what, f"{error.strerror}", fix) from None
    digest = hashlib.sha256(data).hexdigest()
    if digest != sha256:
        raise input_error(file, f"a file with SHA-256 {sha256[:12]}...", f"{digest[:12]}...", fix)
    return data
