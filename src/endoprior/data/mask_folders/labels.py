"""Which labels of an annotation program are tools: those that the user names, else those whose names tell."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ...core.checks import input_error

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


def tool_labels(subject: Path, labels: Sequence[str], asked: str) -> list[str]:
    """The labels that are tools.

    Args:
        subject: file or folder of the labels, for error messages.
        labels: all of them.
        asked: names separated by commas; empty to tell by the names of the labels.
    Raises:
        InputError: a name that is no label, or labels whose names do not tell.
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
