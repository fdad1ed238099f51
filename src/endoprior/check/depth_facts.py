"""Depth of a sequence, measured: coverage, medians, distribution, resolution of what is stored, unit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.config import DataConfig
from ..core.types import Frame
from ..data import FrameSequence
from ..footage.units import UnitGuess, guess_unit

BINS = 80
"""Bins of the histogram."""
EVERY = 7
"""Every 7th pixel enters the distribution."""


@dataclass(frozen=True)
class DepthFacts:
    """Depth as it is read, in mm if the folder is right about its unit."""

    coverage: NDArray[np.float64]
    """(T,) share of tissue pixels with depth; 0 in a frame without tissue."""
    median: NDArray[np.float64]
    """(T,) median depth on tissue; NaN in a frame without any."""
    low: float
    """1st percentile on tissue; 0 without depth."""
    high: float
    """99th percentile on tissue; 0 without depth."""
    edges: NDArray[np.float64]
    """(81,) borders of the histogram's bins."""
    counts: NDArray[np.int64]
    """(80,) tissue pixels in each bin, of those looked at."""
    step: float
    """Usual distance between neighboring values that occur in a frame; 0 without depth."""
    bits: int | None
    """Bits a value is stored with; None where the files do not say."""
    scale: float
    """mm per stored unit: what was asked for, else what the folder says, else 1."""
    unit: UnitGuess
    relative: bool
    """Whether the folder says that its scale is unknown."""


def measure_depth(
    sequence: FrameSequence,
    few: list[Frame],
    tissue: list[NDArray[np.bool_]],
    described: dict[str, Any],
    cfg: DataConfig,
) -> DepthFacts:
    """Measure the depth of every frame, and its distribution on some.

    Args:
        sequence: the whole sequence.
        few: frames whose distribution and unit are looked at.
        tissue: (H, W) each, True on their tissue, masks read inverted put right.
        described: what `sequence.json` says.
        cfg: what the sequence was opened with.
    """
    coverage, median = [], []
    for index in range(len(sequence)):
        frame = sequence.frame(index)
        on_tissue = frame.depth_valid & frame.tissue_mask
        coverage.append(float(on_tissue.sum() / max(frame.tissue_mask.sum(), 1)))
        values = frame.depth[on_tissue][::EVERY]
        median.append(float(np.median(values)) if len(values) else float("nan"))
    values = np.concatenate([f.depth[f.depth_valid & mask][::EVERY] for f, mask in zip(few, tissue, strict=True)])
    low, high = (float(v) for v in np.percentile(values, (1, 99))) if len(values) else (0.0, 0.0)
    room = 0.1 * (high - low) or 0.1 * high or 1.0
    counts, edges = np.histogram(values, BINS, (max(low - room, 0), high + room))
    looked_at = zip(few, tissue, strict=True)
    return DepthFacts(
        np.array(coverage),
        np.array(median),
        low,
        high,
        edges,
        counts,
        _step(few),
        stored_bits(sequence.path / "depth"),
        float(cfg.depth_unit_mm or described.get("depth_scale") or 1.0),
        guess_unit((frame.depth, frame.depth_valid, frame.rgb_u8, mask) for frame, mask in looked_at),
        sequence.depth_is_relative,
    )


def stored_bits(folder: Path) -> int | None:
    """Bits per value of the first PNG in a folder, from its header; None where there is none."""
    for file in sorted(folder.glob("*.png")) if folder.is_dir() else ():
        header = file.read_bytes()[:26]
        return header[24] if len(header) == 26 else None
    return None


def _step(frames: list[Frame]) -> float:
    steps = [np.diff(np.unique(frame.depth[frame.depth_valid])) for frame in frames]
    usual = [float(np.median(step)) for step in steps if len(step)]
    return float(np.median(usual)) if usual else 0.0
