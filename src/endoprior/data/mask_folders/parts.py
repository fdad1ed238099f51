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
from ..images import Size
from ..mask_files import OPTION, HighValues, Mask, asked_labels, read_user_mask
from ..reading import MAX_PIXELS

# A label with a word of the first set is not a tool; with one of the third it is, such as tissue forceps; with one of
# the second alone it is not.
NEVER = {
    "background", "bg", "ignore", "ignored", "unlabeled", "unlabelled", "unknown", "void", "none", "no", "not", "non",
    "border", "outside", "other", "others",
}  # fmt: skip
TISSUE = {
    "tissue", "organ", "anatomy", "mucosa", "blood", "fat", "muscle", "vessel", "artery", "vein", "nerve", "liver",
    "gallbladder", "bowel", "intestine", "colon", "stomach", "kidney", "uterus", "prostate", "bladder", "lung", "heart",
    "wall", "polyp", "tumor", "tumour", "lesion", "skin", "bone", "cartilage", "smoke", "highlight", "reflection",
}  # fmt: skip
TOOLS = {
    "tool", "instrument", "device", "shaft", "wrist", "clasper", "jaw", "tip", "grasper", "forceps", "forcep", "needle",
    "driver", "holder", "scissors", "scissor", "hook", "clip", "clipper", "applier", "stapler", "suction", "irrigator",
    "cautery", "coagulator", "electrode", "bipolar", "monopolar", "probe", "trocar", "retractor", "knife", "scalpel",
    "snare", "catheter", "thread", "suture", "wire", "gauze", "robot", "arm", "hand", "glove", "drill", "ultrasound",
}  # fmt: skip


@dataclass(frozen=True)
class MaskFrame:
    """The mask of one frame."""

    name: str  # file name that holds the name or the number of the frame
    read: Callable[[Size], Mask]
    """(H, W) True where the value is high. Raises InputError if it is unreadable or has another size."""


@dataclass(frozen=True)
class MaskFolder:
    """The masks of a clip, as a program wrote them."""

    frames: Sequence[MaskFrame]  # in natural order
    note: str = ""  # what was recognized, and which labels are tools; empty for plain files
    tool_is_high: bool | None = None  # whether high values mark tools; None where the format does not tell
    in_order_only: bool = False
    """The numbers in the names are not those of frames: masks belong to frames in order, if there are as many."""


def sorted_frames(frames: Sequence[MaskFrame]) -> list[MaskFrame]:
    """The frames in natural order of their names."""
    keys = sorting_keys([Path(frame.name).stem for frame in frames])
    return [frames[i] for i in sorted(range(len(frames)), key=keys.__getitem__)]


def union_of_files(files: Sequence[Path], rule: HighValues | None = None) -> Callable[[Size], Mask]:
    """Reads the union of some mask files; of none, an empty mask. Args: rule: as `read_user_mask`."""
    return lambda size: union((read_user_mask(file, size, rule) for file in files), size)


def union(masks: Iterable[Mask], size: Size) -> Mask:
    """(H, W) True where any of the masks is."""
    return np.any([np.zeros(size[::-1], bool), *masks], axis=0)


def tool_labels(subject: Path, labels: Sequence[str], asked: str) -> list[str]:
    """The labels of `subject` that are tools: those asked for, separated by commas, else by the words of the labels."""
    known, example = ", ".join(labels), (labels or ["tool"])[0]
    if asked:
        return asked_labels(subject, asked, dict(zip(labels, labels, strict=True)), known, example)
    kinds = {label: _is_tool(label) for label in labels}
    candidates = [label for label, is_tool in kinds.items() if is_tool is not False]
    if len(candidates) == 1 or (candidates and all(kinds[label] for label in candidates)):
        return candidates
    fix = f"Name those of tools, for example `{OPTION} {(candidates or [example])[0]}`."
    raise input_error(subject, "labels whose names tell which are tools", known or "none", fix)


def words_about(labels: Sequence[str], tools: Sequence[str]) -> str:
    """`tools: shaft, jaw; not tools: tissue`."""
    rest = [label for label in labels if label not in tools]
    return f"tools: {', '.join(tools)}" + (f"; not tools: {', '.join(rest)}" if rest else "")


def _is_tool(label: str) -> bool | None:
    """Whether a label is a tool; None if its words do not tell."""
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", label).lower())
    found = {form for word in words for form in (word, word.removesuffix("s"))}
    if found & NEVER:
        return False
    return True if found & TOOLS else False if found & TISSUE else None


def mask_of_runs(runs: Sequence[int], num_pixels: int) -> Mask:
    """(num_pixels,) from lengths of runs outside, inside, ... of an object; ValueError if they do not fill the mask."""
    lengths = np.asarray(runs, np.int64)
    if num_pixels > MAX_PIXELS or lengths.ndim != 1:
        raise ValueError(f"run lengths of {num_pixels} px")
    # Each alone, too: the sum of huge numbers can wrap around.
    if ((lengths < 0) | (lengths > num_pixels)).any() or int(lengths.sum()) != num_pixels:
        raise ValueError(f"run lengths of {int(lengths.sum())} px for {num_pixels} px")
    return np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)


def mask_of_coco(counts: str | Sequence[int], size: Sequence[int]) -> NDArray[np.bool_]:
    """(H, W) from COCO's run lengths, numbers or their text, and height, width; ValueError as `mask_of_runs`."""
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
