"""Measure the depth of a sequence: coverage, medians, distribution, stored resolution, unit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.config import DataConfig
from ..core.types import Frame
from ..data import FrameSequence
from ..footage.units import FAR_MM, UnitGuess, guess_unit

BINS = 80
"""Number of histogram bins."""
EVERY = 7
"""The distribution uses every 7th pixel."""


@dataclass(frozen=True)
class DepthFacts:
    """Depth as read; in mm if the folder states the right unit."""

    coverage: NDArray[np.float64]
    """(T,) share of tissue pixels with depth; 0 in a frame without tissue."""
    median: NDArray[np.float64]
    """(T,) median depth on tissue; NaN in a frame without any."""
    far: NDArray[np.float64]
    """(T,) share of the tissue pixels with depth that are farther than `FAR_MM`; 0 in a frame without any."""
    low: float
    """1st percentile on tissue; 0 without depth."""
    high: float
    """99th percentile on tissue; 0 without depth."""
    edges: NDArray[np.float64]
    """(81,) edges of the histogram bins."""
    counts: NDArray[np.int64]
    """(80,) sampled tissue pixels in each bin."""
    step: float
    """Median difference between neighboring values of a frame; 0 without depth."""
    bits: int | None
    """Bits per stored value; None if unknown."""
    scale: float
    """mm per stored unit: the option, else the value in `sequence.json`, else 1."""
    unit: UnitGuess
    relative: bool
    """Whether the folder states that its scale is unknown."""


def measure_depth(
    sequence: FrameSequence,
    samples: list[Frame],
    tissue: list[NDArray[np.bool_]],
    described: dict[str, Any],
    cfg: DataConfig,
) -> DepthFacts:
    """Measure coverage and median of every frame, and the distribution over sample frames.

    Args:
        sequence: the whole sequence.
        samples: frames for the distribution and the unit.
        tissue: (H, W) each, True on their tissue; inverted masks are corrected.
        described: content of `sequence.json`.
        cfg: options with which the sequence was opened.
    """
    coverage, median, far = [], [], []
    for index in range(len(sequence)):
        frame = sequence.frame(index)
        on_tissue = frame.depth_valid & frame.tissue_mask
        coverage.append(float(on_tissue.sum() / max(frame.tissue_mask.sum(), 1)))
        values = frame.depth[on_tissue][::EVERY]
        median.append(float(np.median(values)) if len(values) else float("nan"))
        far.append(float((frame.depth[on_tissue] > FAR_MM).mean()) if len(values) else 0.0)
    values = np.concatenate([f.depth[f.depth_valid & mask][::EVERY] for f, mask in zip(samples, tissue, strict=True)])
    low, high = (float(v) for v in np.percentile(values, (1, 99))) if len(values) else (0.0, 0.0)
    margin = 0.1 * (high - low) or 0.1 * high or 1.0
    counts, edges = np.histogram(values, BINS, (max(low - margin, 0), high + margin))
    pairs = zip(samples, tissue, strict=True)
    return DepthFacts(
        np.array(coverage),
        np.array(median),
        np.array(far),
        low,
        high,
        edges,
        counts,
        _step(samples),
        stored_bits(sequence.path / "depth"),
        float(cfg.depth_unit_mm or described.get("depth_scale") or 1.0),
        guess_unit((frame.depth, frame.depth_valid, frame.rgb_u8, mask) for frame, mask in pairs),
        sequence.depth_is_relative,
    )


def stored_bits(folder: Path) -> int | None:
    """Bits per value of the first PNG in a folder, from its header; None if there is none."""
    for file in sorted(folder.glob("*.png")) if folder.is_dir() else ():
        header = file.read_bytes()[:26]
        return header[24] if len(header) == 26 else None
    return None


def _step(frames: list[Frame]) -> float:
    steps = [np.diff(np.unique(frame.depth[frame.depth_valid])) for frame in frames]
    usual = [float(np.median(step)) for step in steps if len(step)]
    return float(np.median(usual)) if usual else 0.0
