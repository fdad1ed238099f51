"""What every score has: name, unit, which way is better; and what it is when it cannot be computed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from ..core.geometry import length_unit

Group = Literal["image", "depth", "motion", "model", "speed", "masks", "other"]
GROUPS: tuple[Group, ...] = get_args(Group)  # What a score is about, in the order of the printed table


class ScoreUnavailable(RuntimeError):
    """A score cannot be computed here; the text is the one-line reason to report instead."""


def mean_over_frames(values: Iterable[float]) -> float:
    """Mean of the finite values; NaN when there is none. NaN marks a frame on which the score is undefined (no tissue,
    no depth, no tool). Infinity is the PSNR of two equal images: one such frame would hide all others.
    """
    array = np.asarray(list(values), dtype=np.float64)
    finite = array[np.isfinite(array)]
    return float(finite.mean()) if finite.size else float("nan")


@dataclass(frozen=True)
class Score:
    """One number that says how good a scene is. Tables, reports and comparisons read from here how to show it."""

    name: str
    """Key in `metrics.json`."""
    label: str
    """What tables and figures call it, without the unit."""
    unit: str
    """Such as dB, mm or px; empty for a plain number."""
    higher_is_better: bool | None
    """None: neither way. Tables do not rank such a score, and comparisons count fewer as better."""
    digits: int
    """Decimals in printed summaries."""
    description: str
    """One sentence for docs/scores.md."""
    compare: Literal["absolute", "relative"] = "relative"
    """How two methods differ: in the score's own unit, or as a share of the second one's value."""
    group: Group = "other"
    hint: str = ""
    """A few words beside the printed value: what is good, or what to know of it. Only what can be said of any video."""
    in_summary: bool = True
    """Whether `endoprior train` and `eval` print it; metrics.json has every score."""
    stands_for: str = ""
    """Name of the score in whose place it is printed when that one has no value; of scores outside of summaries."""
    in_true_mm: bool = False
    """Whether its length is measured in the ground truth, in mm also where the depth of the sequence is relative."""

    def variant(self, end: str, label: str, of: str, *, in_summary: bool = False) -> Score:
        """The same score `of` something else, such as "chained flow"; `end` and `label` are added to name and label."""
        name, description = f"{self.name}_{end}", f"`{self.name}` of {of}."
        full_label = f"{self.label}, {label}"
        return replace(self, name=name, label=full_label, description=description, in_summary=in_summary, hint="")

    @property
    def is_length(self) -> bool:
        """Whether it is in mm, which it is not where depth is relative."""
        return self.unit == "mm" and not self.in_true_mm

    def shown_unit(self, relative: bool = False) -> str:
        """The unit to show. `relative`: whether the scale of the depth is unknown."""
        return length_unit(relative) if self.is_length else self.unit

    def heading(self, relative: bool = False) -> str:
        """Label and unit: `tissue PSNR, dB`."""
        return f"{self.label}, {self.shown_unit(relative)}".removesuffix(", ")

    @property
    def arrow(self) -> str:
        """Up if higher is better, down if lower is; empty for neither."""
        return {True: "\u2191", False: "\u2193", None: ""}[self.higher_is_better]

    def text(self, value: float, relative: bool = False) -> str:
        """A value with its unit: `31.27 dB`."""
        return f"{value:,.{self.digits}f} {self.shown_unit(relative)}".rstrip()
