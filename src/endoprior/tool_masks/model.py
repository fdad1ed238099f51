"""Fit a model of the tools of one clip to a few of its frames, and find the tools in each frame.

1. `colors`: a first guess of where tools are, from color and contrast in units of the clip.
2. `attachment`: colors that move with their surroundings are tissue.
3. `network`: a small network learns tissue from the pixels that 1 and 2 are sure of, and tools from painted ones.
4. `relief`: with stereo or measured depth, how much nearer the found tools are.
5. `regions`: what enters the view end first is a tool.

The masks are a starting point: correct them in the viewer, or pass your own. `H, W` image size, `h, w` resized size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import check_shape
from .attachment import attachment_log_odds, color_cells, independence
from .colors import FEATURES_PX, ClipColors, first_guess
from .network import Background, ToolNetwork, log_odds_of, network_size, shrunk, train_network
from .regions import disk, tool_regions
from .relief import relief_cells, relief_log_odds

LEAST_REDNESS = 0.06
"""Median log(red / green) below which a clip is gray: its colors tell nothing, and no tools are looked for."""
UNSURE = 0.35
"""Pixels whose first guess is a higher probability are not used as examples of tissue."""
UNSURE_RIM_PX = 6
"""Nor are those closer to them than this, px of the network's image: thin jaws are seldom guessed."""
MISSED_PX = 12
"""Near a given mask, pixels up to this distance may be a part that it misses."""
STEPS = 150
"""Training steps of the network. With 72 the tools of a phantom are hardly above the threshold, with 48 below it. With
200 the end of the fast tool of `mono_endo` is covered better, but a preview takes over a minute; with 300 more tissue
is taken (docs/log.md)."""
GUESS_WEIGHT = 0.3
"""Weight of the first guess beside the network, which sees half of the resolution: it sharpens the outlines."""
SHINE = (0.6, 0.8)
"""Range of the smallest channel over which a pixel changes from surface color to pure highlight."""
RIM_PX = 1
"""The mask is dilated by this much to cover mixed pixels at the tool's edge."""
UNCERTAIN = 0.5
"""Masks of a lower confidence should be looked at."""


@dataclass(frozen=True)
class ToolSample:
    """One frame that the model is fitted to."""

    rgb_u8: NDArray[np.uint8]
    """(H, W, 3), 0..255."""
    view: NDArray[np.bool_]
    """(H, W) True inside the endoscope's image."""
    later_u8: NDArray[np.uint8] | None = None
    """(H, W, 3) a frame about a tenth of a second later, 0..255; None at the end of the clip."""
    depth: NDArray[np.float32] | None = None
    """(H, W) z, mm, 0 or not finite where missing; None without depth."""
    given: NDArray[np.bool_] | None = None
    """(H, W) True on tools, a mask that is right but may miss parts; None without such masks."""


@dataclass(frozen=True)
class FoundTools:
    """The tools of one frame."""

    mask: NDArray[np.bool_]
    """(H, W) True on the tools: filled regions that enter from the border of the view."""
    confidence: float
    """0..1: how far the probabilities of all pixels that may be a tool are from one half, on average; 1 if there are
    none."""

    @property
    def uncertain(self) -> bool:
        """Whether the mask should be looked at."""
        return bool(self.mask.any()) and self.confidence < UNCERTAIN


@dataclass(frozen=True)
class ToolModel:
    """What tissue and tools of one clip look like."""

    clip: ClipColors
    network: ToolNetwork | None
    """None for a gray clip or an empty view: all masks are empty."""
    attachment: NDArray[np.float32]
    """(cells,) log-odds of the cells of `color_cells`, from motion."""
    relief: NDArray[np.float32] | None
    """(cells,) log-odds of `relief_cells`; None without depth."""
    in_samples: tuple[FoundTools, ...]
    """The tools of each sample whose view is not empty, at the size that the model works on; none for a gray clip."""

    @property
    def detected_share(self) -> float:
        """Share of the samples in which a tool was found, 0..1."""
        return sum(bool(found.mask.any()) for found in self.in_samples) / max(len(self.in_samples), 1)

    def find(
        self, rgb_u8: NDArray[np.uint8], view: NDArray[np.bool_], depth: NDArray[np.float32] | None = None
    ) -> FoundTools:
        """Find the tools of one frame.

        Args:
            rgb_u8: (H, W, 3) color, 0..255.
            view: (H, W) True inside the endoscope's image.
            depth: (H, W) z, mm, 0 or not finite where missing; used only if the model was fitted with depth.
        Raises:
            ValueError: shapes that do not match.
        """
        check_shape("rgb_u8:H,W,3 view:H,W", rgb_u8=rgb_u8, view=view)
        if self.network is None or not view.any():
            return FoundTools(np.zeros_like(view), 1.0)
        work = _work_sample(ToolSample(rgb_u8, view, None, depth))
        guess = first_guess(work.rgb_u8, work.view, self.clip) + self.attachment[color_cells(work.rgb_u8, self.clip)]
        found = _found(_probability(self.network, guess, self.relief, work, self.clip), work.view)
        wide = cv2.dilate(found.mask.astype(np.uint8), disk(RIM_PX))
        large = cv2.resize(wide.astype(np.float32), view.shape[::-1], interpolation=cv2.INTER_LINEAR)
        return FoundTools((large > 0.5) & view, found.confidence)


def fit_tools(samples: Sequence[ToolSample], seed: int = 0) -> ToolModel:
    """Fit the model: about 18 s on two cores for 16 samples of 640x512.

    Args:
        samples: 10 to 20 frames spread over the clip, of one size.
    Raises:
        ValueError: no samples, or shapes that do not match.
    """
    if not samples:
        raise ValueError("samples must hold at least one frame, got none")
    work = [_work_sample(sample) for sample in samples]
    clip = ClipColors.of([sample.rgb_u8 for sample in work], [sample.view for sample in work])
    usable = [sample for sample in work if sample.view.any()]
    if not usable or clip.redness < LEAST_REDNESS:
        return ToolModel(clip, None, np.zeros(0, np.float32), None, ())
    colors = [first_guess(sample.rgb_u8, sample.view, clip) for sample in usable]
    cells = [color_cells(sample.rgb_u8, clip) for sample in usable]
    attachment = _attachment(usable, colors, cells)
    guesses = [color + attachment[cell] for color, cell in zip(colors, cells, strict=True)]
    backgrounds = [_background(sample, guess, clip) for sample, guess in zip(usable, guesses, strict=True)]
    network = train_network(backgrounds, clip, STEPS, seed)
    tools = [
        _found(_probability(network, guess, None, sample, clip), sample.view)
        for sample, guess in zip(usable, guesses, strict=True)
    ]
    measured = [(s.depth, tool.mask, s.view) for s, tool in zip(usable, tools, strict=True) if s.depth is not None]
    return ToolModel(clip, network, attachment, relief_log_odds(measured), tuple(tools))


def _found(probability: NDArray[np.float32], view: NDArray[np.bool_]) -> FoundTools:
    """The tools of one frame, from the probability (h, w) of each pixel."""
    mask = tool_regions(probability, view)
    maybe = probability[mask | (probability > UNSURE)]
    return FoundTools(mask, float(np.abs(2 * maybe - 1).mean()) if maybe.size else 1.0)


def _work_sample(sample: ToolSample) -> ToolSample:
    """The sample, resized to `FEATURES_PX` on its longer side, so that radii have the same meaning for every size."""
    check_shape("rgb_u8:H,W,3 view:H,W", rgb_u8=sample.rgb_u8, view=sample.view)
    height, width = sample.view.shape
    scale = FEATURES_PX / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    kind = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    later = None if sample.later_u8 is None else cv2.resize(sample.later_u8, size, interpolation=kind)
    depth = sample.depth
    if depth is not None:
        check_shape("view:H,W depth:H,W", view=sample.view, depth=depth)
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
        depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
    view = cv2.resize(sample.view.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    given = None
    if sample.given is not None:
        given = cv2.resize(sample.given.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return ToolSample(cv2.resize(sample.rgb_u8, size, interpolation=kind), view, later, depth, given)


def _attachment(
    samples: Sequence[ToolSample], colors: Sequence[NDArray[np.float32]], cells: Sequence[NDArray[np.int32]]
) -> NDArray[np.float32]:
    """(cells,) log-odds of a tool for each color, from the motion of all samples.

    Args:
        colors: (h, w) first guess of each sample.
        cells: (h, w) color cells of each sample.
    """
    moved = [
        (cell, *independence(sample.rgb_u8, sample.later_u8, sample.view, guess))
        for sample, guess, cell in zip(samples, colors, cells, strict=True)
        if sample.later_u8 is not None
    ]
    return attachment_log_odds(moved, sum(int(sample.view.sum()) for sample in samples))


def _without_highlights(probability: NDArray[np.float32], sample: ToolSample, clip: ClipColors) -> NDArray[np.float32]:
    """Highlights have one color on tools and on tissue: they take the mean probability of their surroundings."""
    paleness = (sample.rgb_u8.min(-1).astype(np.float32) / np.float32(clip.white) - SHINE[0]) / (SHINE[1] - SHINE[0])
    shine = cv2.dilate(np.clip(paleness, 0, 1), disk(2))
    matte = (1 - shine) * sample.view + np.float32(1e-3)
    around = cv2.GaussianBlur(matte * probability, (0, 0), 4) / cv2.GaussianBlur(matte, (0, 0), 4)
    return (probability + shine * (around - probability)) * sample.view


def _background(sample: ToolSample, guess: NDArray[np.float32], clip: ClipColors) -> Background:
    """The sample at the size of the network, and which of its pixels are surely tissue."""
    size = network_size(sample.view.shape[::-1])
    view = shrunk(sample.view.astype(np.float32), size) > 0.5
    probability = _without_highlights(_sigmoid(guess), sample, clip)
    rgb = shrunk(sample.rgb_u8, size).astype(np.float32) / np.float32(clip.white)
    if sample.given is None:
        tools, unsure, rim_px = np.zeros_like(view), shrunk(probability, size) > UNSURE, UNSURE_RIM_PX
    else:
        tools = view & (shrunk(sample.given.astype(np.float32), size) > 0.5)
        unsure, rim_px = tools, MISSED_PX
    return Background(rgb, view, view & ~(cv2.dilate(unsure.astype(np.uint8), disk(rim_px)) > 0), tools)


def _probability(
    network: ToolNetwork,
    guess: NDArray[np.float32],
    relief: NDArray[np.float32] | None,
    work: ToolSample,
    clip: ClipColors,
) -> NDArray[np.float32]:
    """(h, w) probability of a tool; `guess` (h, w) is its log-odds from color and motion."""
    size = network_size(work.view.shape[::-1])
    rgb = shrunk(work.rgb_u8, size).astype(np.float32) / np.float32(clip.white)
    log_odds = log_odds_of(network, rgb, shrunk(work.view.astype(np.float32), size) > 0.5, clip)
    log_odds = cv2.resize(log_odds, work.view.shape[::-1], interpolation=cv2.INTER_LINEAR)
    log_odds = log_odds + np.float32(GUESS_WEIGHT) * guess
    if relief is not None and work.depth is not None:
        log_odds = log_odds + relief[relief_cells(work.depth, work.view & (log_odds < 0))]
    return _sigmoid(log_odds) * work.view


def _sigmoid(log_odds: NDArray[np.float32]) -> NDArray[np.float32]:
    return (1 / (1 + np.exp(-log_odds))).astype(np.float32)
