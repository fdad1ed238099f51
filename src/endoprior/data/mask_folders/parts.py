"""What the formats of mask folders share: masks by frame, which labels are tools, run lengths. `H, W` image size."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.checks import input_error
from ..files import sorting_keys
from ..mask_files import HighValues, read_user_mask
from ..reading import MOST_PIXELS

Mask = NDArray[np.bool_]
Size = tuple[int, int]
"""(width, height), px."""
OPTION = "--mask-labels"
NEVER = {
    "background", "bg", "ignore", "ignored", "unlabeled", "unlabelled", "unknown", "void", "none", "no", "not", "non",
    "border", "outside", "other", "others",
}  # fmt: skip
"""A label with one of these words is not a tool."""
TISSUE = {
    "tissue", "organ", "anatomy", "mucosa", "blood", "fat", "muscle", "vessel", "artery", "vein", "nerve", "liver",
    "gallbladder", "bowel", "intestine", "colon", "stomach", "kidney", "uterus", "prostate", "bladder", "lung", "heart",
    "wall", "polyp", "tumor", "tumour", "lesion", "skin", "bone", "cartilage", "smoke", "highlight", "reflection",
}  # fmt: skip
"""A label with one of these words is not a tool, unless it has a word of a tool too: tissue forceps."""
TOOLS = {
    "tool", "instrument", "device", "shaft", "wrist", "clasper", "jaw", "tip", "grasper", "forceps", "forcep", "needle",
    "driver", "holder", "scissors", "scissor", "hook", "clip", "clipper", "applier", "stapler", "suction", "irrigator",
    "cautery", "coagulator", "electrode", "bipolar", "monopolar", "probe", "trocar", "retractor", "knife", "scalpel",
    "snare", "catheter", "thread", "suture", "wire", "gauze", "robot", "arm", "hand", "glove", "drill", "ultrasound",
}  # fmt: skip
"""Words of things that are not part of the scene."""


@dataclass(frozen=True)
class MaskFrame:
    """The mask of one frame."""

    name: str
    """File name that holds the name or the number of the frame."""
    read: Callable[[Size], Mask]
    """(H, W) True where the value is high. Raises InputError if it is unreadable or has another size."""


@dataclass(frozen=True)
class MaskFolder:
    """The masks of a clip, as a program wrote them."""

    frames: Sequence[MaskFrame]
    """In natural order."""
    note: str = ""
    """What was recognized, and which labels are tools; empty for plain files."""
    tool_is_high: bool | None = None
    """Whether high values mark tools; None where the format does not tell."""
    in_order_only: bool = False
    """The numbers in the names are not those of frames: masks belong to frames in order, if there are as many."""


def sorted_frames(frames: Sequence[MaskFrame]) -> list[MaskFrame]:
    """The frames in natural order of their names."""
    keys = sorting_keys([Path(frame.name).stem for frame in frames])
    return [frames[i] for i in sorted(range(len(frames)), key=keys.__getitem__)]


def union_of_files(files: Sequence[Path], rule: HighValues | None = None) -> Callable[[Size], Mask]:
    """Reads the union of some mask files; of none, an empty mask. Args: rule: as `read_user_mask`."""

    def read(size: Size) -> Mask:
        return union((read_user_mask(file, size, rule) for file in files), size)

    return read


def union(masks: Iterable[Mask], size: Size) -> Mask:
    """(H, W) True where any of the masks is."""
    return np.any([np.zeros(size[::-1], bool), *masks], axis=0)


def demand_size(subject: Path | str, got: Size, size: Size) -> None:
    """Raise InputError unless a mask has the size of the frames."""
    if got != size:
        want = f"{size[0]}x{size[1]} px like the images"
        raise input_error(subject, want, f"{got[0]}x{got[1]}", "Export masks at the size of the images.")


def tool_labels(subject: Path, labels: Sequence[str], asked: str) -> list[str]:
    """The labels that are tools.

    Args:
        subject: file or folder of the labels, for error messages.
        labels: all of them.
        asked: names separated by commas; empty to tell by the names of the labels.
    """
    known = ", ".join(labels)
    if asked:
        by_name = {_plain(label): label for label in labels}
        names = [name.strip() for name in asked.split(",") if name.strip()]
        for name in names:
            if _plain(name) not in by_name:
                raise input_error(OPTION, f"labels of {subject} ({known})", name, f"`{OPTION} {labels[0]}`.")
        return [by_name[_plain(name)] for name in names]
    candidates = [label for label in labels if _kind(label) != "not a tool"]
    if len(candidates) == 1 or (candidates and all(_kind(label) == "a tool" for label in candidates)):
        return candidates
    fix = f"Name those of tools, for example `{OPTION} {(candidates or labels or ['tool'])[0]}`."
    raise input_error(subject, "labels whose names tell which are tools", known or "none", fix)


def words_about(labels: Sequence[str], tools: Sequence[str]) -> str:
    """`tools: shaft, jaw; not tools: tissue`."""
    rest = [label for label in labels if label not in tools]
    return f"tools: {', '.join(tools)}" + (f"; not tools: {', '.join(rest)}" if rest else "")


def chosen_objects(subject: Path, objects: Sequence[str], asked: str) -> list[str]:
    """Objects that have numbers in place of names: all of them are tools, unless some are asked for."""
    return tool_labels(subject, objects, asked) if asked else list(objects)


def _plain(name: str) -> str:
    """A name without case and leading zeros, so that 001 is 1."""
    return name.strip().casefold().lstrip("0") or "0"


def _kind(label: str) -> str:
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", label).lower())
    found = {form for word in words for form in (word, word.removesuffix("s"))}
    if found & NEVER:
        return "not a tool"
    if found & TOOLS:
        return "a tool"
    return "not a tool" if found & TISSUE else "unknown"


def mask_of_runs(runs: Sequence[int], num_pixels: int) -> NDArray[np.bool_]:
    """(num_pixels,) from lengths of runs that are outside, inside, outside, ... of an object.

    Raises:
        ValueError: a negative length, or lengths that do not fill the mask.
    """
    lengths = np.asarray(runs, np.int64)
    if num_pixels > MOST_PIXELS or lengths.ndim != 1:
        raise ValueError(f"run lengths of {num_pixels} px")
    # Each alone, too: the sum of huge numbers can wrap around.
    if ((lengths < 0) | (lengths > num_pixels)).any() or int(lengths.sum()) != num_pixels:
        raise ValueError(f"run lengths of {int(lengths.sum())} px for {num_pixels} px")
    return np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)


def mask_of_coco(counts: str | Sequence[int], size: Sequence[int]) -> NDArray[np.bool_]:
    """(H, W) from COCO's run lengths.

    Args:
        counts: lengths, or the text that holds them.
        size: height, width.
    Raises:
        ValueError: as `mask_of_runs`, or the text is cut off.
    """
    height, width = (int(side) for side in size)
    runs = _unpacked(counts) if isinstance(counts, str) else list(counts)
    return mask_of_runs(runs, height * width).reshape(width, height).T


def _unpacked(text: str) -> list[int]:
    """Lengths from text: 5 bits a character, lowest first; from the fourth on, differences to the one before last."""
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64:
            raise ValueError(f"the character {character!r} in run lengths")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:  # negative: the bits above are ones
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("run lengths that are cut off")
    return runs
