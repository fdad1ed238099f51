"""How good a model is, in one of four words, and why: so that nothing wrong is ever called done.

A rule looks at one piece of evidence and says how good the model can be at best. The worst rule decides; its words are
the reason. Limits come from clips whose models were looked at, and from failures made up on phantoms (docs/log.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

Word = Literal["good", "usable", "doubtful", "wrong"]
WORDS: tuple[Word, ...] = get_args(Word)
"""From best to worst."""
GOOD, USABLE, DOUBTFUL, WRONG = range(len(WORDS))
TO_LOOK_AT = (
    "good to look at", "good enough to look at", "look at it only beside the video", "wrong: do not use it",
)  # fmt: skip
"""What the images of a model are good for, by how good they are."""
TO_MEASURE = ("it can be measured", "measure with care", "do not measure")
NO_MILLIMETERS = "do not measure: lengths are not millimeters"
OVER_FLOW_DB, TISSUE_DB = (-3.0, -6.0), (33.0, 28.0)
"""Held-out frames are good, or usable, if their PSNR is near that of the nearest training frame moved by flow, or high.
The moved frame is hard to beat: it has all texture, and the flow has seen the held-out frame."""
BLURRED_DB = 28.0  # below, frames are so far off that they must at least beat simple references clearly:
WRONG_OVER_MEAN_DB = 2.0  # the mean of all frames by this, else nothing was learned,
FOLLOWED_DB = 3.0  # as the moved frame must, else not even flow follows this video
MIN_FRAME_SHARES = (0.8, 0.5)  # share of the frames that could be used
SLIP_PX = (4.0, 10.0)
MEASURED = 0.5  # share of the tissue from which parallax tells the depth of the whole
DEPTH_ERROR = (0.15, 0.35)
RELIEF = 0.1  # least correlation of the relief; sound phantoms have 0.2 to 0.5, flat and inverted depth less than 0
CONTRADICTED = {
    "camera-moves": "the camera moves, and the stored poses say that it is static: its motion becomes that of tissue",
    "poses-convention": "the stored camera poses do not explain the images",
    "depth-disparity": "the stored depth looks like disparity: near is far",
}
"""Findings of `check` with which no model is sound, and what they mean."""
TOOLS_MISSED = (0.05, 0.15)
"""Share of the frames in which training found what looks like a missed tool. It finds few of those that are missed."""


@dataclass(frozen=True)
class VerdictFacts:
    """What the verdict needs beside scores."""

    share_used: float = 1.0
    """Share of the frames of the chosen part that were trained on or scored, 0..1."""
    share_with_missed_tools: float = 0.0
    lengths_are_relative: bool = False
    """Their unit is unknown: they are not mm."""
    depth_is_guessed: bool = False
    """Depth is guessed from one camera."""
    depth_measured: float | None = None
    """Share of the tissue whose depth the motion of the camera measured, 0..1; None where nothing was measured so."""
    motion_is_unknown: bool = False
    """The camera moves, or may move, and its path was not found."""
    findings: tuple[str, ...] = ()
    """Codes of what `check` found in the input."""


@dataclass(frozen=True)
class Verdict:
    """A word and its reasons, one line each; those that decided come first."""

    word: Word
    reasons: tuple[str, ...]
    plain: str = ""
    """What the model is good for, for one who does not read figures: to look at, and to measure."""

    def __str__(self) -> str:
        return f"{self.word}: {'; '.join(self.reasons)}"


def verdict_on(scores: Mapping[str, float], facts: VerdictFacts) -> Verdict:
    """The verdict on a model. Args: scores: of held-out frames, by name (docs/scores.md)."""
    seen = [*_images(scores), *_frames(facts)]
    motion = [*_motion(scores, facts)]
    found = [*seen, *motion, *_depth(scores, facts)]
    found += [(DOUBTFUL, reason) for code, reason in CONTRADICTED.items() if code in facts.findings]
    worst = max((level for level, _ in found), default=DOUBTFUL)
    reasons = [reason for level, reason in found if level == worst]
    also = [reason for level, reason in found if USABLE <= level < worst] if worst > USABLE else []
    looks, moves = (max((level for level, _ in part), default=GOOD) for part in (seen, motion))
    return Verdict(WORDS[worst], (*reasons, *also), _plain(looks, moves, worst, facts.lengths_are_relative))


def _plain(looks: int, moves: int, worst: int, relative: bool) -> str:
    """What a model is good for. Args: looks, moves: how good its images and its motion are; worst: all of it."""
    if worst == WRONG:
        return TO_LOOK_AT[WRONG].capitalize()
    slides = ", but its tissue may not move as the real one does" if moves == DOUBTFUL > looks else ""
    return f"{TO_LOOK_AT[looks]}{slides}; {NO_MILLIMETERS if relative else TO_MEASURE[worst]}".capitalize()


def _graded(value: float, limits: Sequence[float]) -> int:
    """GOOD, USABLE or DOUBTFUL of a value that should be small; of one that should be large, negate both."""
    return sum(value > limit for limit in limits)


def _images(scores: Mapping[str, float]) -> Iterator[tuple[int, str]]:
    """Whether held-out frames look as they should."""
    if "psnr_tissue" not in scores:
        yield DOUBTFUL, "no frame was held out to compare with"
        return
    tissue, told = scores["psnr_tissue"], f"held-out frames: {scores['psnr_tissue']:.1f} dB"
    over_flow, over_mean = scores.get("gain_over_flow"), scores.get("gain_over_mean")
    if over_flow is None or over_mean is None:
        yield _graded(-tissue, [-limit for limit in TISSUE_DB]), told
        return
    if tissue < BLURRED_DB and over_mean < WRONG_OVER_MEAN_DB:
        yield WRONG, f"{told}; the mean of all frames alone has {tissue - over_mean:.1f} dB"
    elif tissue < BLURRED_DB and over_mean - over_flow < FOLLOWED_DB:
        yield DOUBTFUL, f"{told}, and optical flow does not follow the video either"
    else:
        words = f"{abs(over_flow):.1f} dB {'above' if over_flow >= 0 else 'below'} the nearest frame moved by flow"
        by_flow = _graded(-over_flow, [-limit for limit in OVER_FLOW_DB])
        yield min(by_flow, _graded(-tissue, [-limit for limit in TISSUE_DB])), f"{told}, {words}"


def _motion(scores: Mapping[str, float], facts: VerdictFacts) -> Iterator[tuple[int, str]]:
    """Whether tissue goes where the video shows it going, and the camera where it went."""
    if (slip := scores.get("slip_px")) is not None:
        yield _graded(slip, SLIP_PX), f"tissue slips by {slip:.1f} px in 12 frames against the flow"
    elif "psnr_tissue" in scores:
        yield USABLE, "too few points of tissue can be followed to confirm how it moves"
    if facts.motion_is_unknown:
        yield DOUBTFUL, "the camera moves and its path is unknown: depth and motion of tissue are mixed up"


def _depth(scores: Mapping[str, float], facts: VerdictFacts) -> Iterator[tuple[int, str]]:
    """Whether depth agrees with what the moving camera saw, or was measured by two."""
    error = scores.get("depth_triangulated_error")
    if error is not None:
        yield _graded(error, DEPTH_ERROR), f"depth is {error:.0%} off what the moving camera triangulates"
    if (relief := scores.get("depth_relief", 1.0)) < RELIEF:
        told = f"(correlation {relief:.2f})"
        yield DOUBTFUL, f"depth does not rise and fall as the moving camera triangulates it {told}"
    share = facts.depth_measured
    if share is not None and share < MEASURED:
        yield USABLE, f"depth is measured by parallax on {share:.0%} of the tissue, and a guess beside it"
    elif share is None and error is None and facts.depth_is_guessed:
        yield USABLE, "depth is a guess from one camera that nothing confirms: do not trust views from the side"


def _frames(facts: VerdictFacts) -> Iterator[tuple[int, str]]:
    """Whether enough of the video could be used."""
    if facts.share_used < 1:
        least = [-limit for limit in MIN_FRAME_SHARES]
        yield _graded(-facts.share_used, least), f"only {facts.share_used:.0%} of the frames could be used"
    if facts.share_with_missed_tools > 0:
        share = facts.share_with_missed_tools
        yield _graded(share, TOOLS_MISSED), f"a tool is likely missed in {share:.0%} of the frames"
