"""Clean measured depth: which values count as measured, and how outliers are clipped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.config import DataConfig


def clean_depth(
    raw: NDArray[np.floating], cfg: DataConfig | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Separate measured from missing depth, and clip the measured values to two of their own percentiles.

    Args:
        raw: (H, W) depth, mm; missing where 0, negative or not finite.
        cfg: percentiles, and `lift_missing_depth`, which treats missing depth as near, as EndoGaussian does.
    Returns:
        (H, W) depth, mm, 0 where missing, and (H, W) bool, True where measured. A frame without any measured depth
        is all 0 and False, lifted or not.
    """
    cfg = cfg or DataConfig()
    raw = np.asarray(raw, np.float32)
    valid = np.isfinite(raw) & (raw > 0)
    measured = raw[valid]
    if measured.size == 0:
        return np.zeros_like(raw), valid
    near, far = np.percentile(measured, (cfg.depth_clip_low_percentile, cfg.depth_clip_high_percentile))
    missing = near if cfg.lift_missing_depth else 0
    depth = np.where(valid, np.clip(raw, np.float32(near), np.float32(far)), np.float32(missing))
    return depth, np.ones_like(valid) if cfg.lift_missing_depth else valid
