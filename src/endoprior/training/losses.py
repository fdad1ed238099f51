"""The supervised terms of one rendered image against its frame, weighted as in Eq. (12)."""

from __future__ import annotations

from torch import Tensor

from ..core.config import LossConfig
from ..core.types import RenderOutput
from .frames import TrainingFrame
from .ops import TrainingOps


def supervised_terms(out: RenderOutput, frame: TrainingFrame, cfg: LossConfig, ops: TrainingOps) -> dict[str, Tensor]:
    """Weighted color, depth, total-variation and edge terms, and that of what is hidden, () each."""
    depth = out.depth / out.alpha.clamp(min=1e-6) if cfg.depth_mode == "expected" else out.depth
    depth_weight = cfg.depth_weight if frame.num_measured >= cfg.min_depth_pixels else 0.0
    fused = ops.supervised_losses(
        out.color,
        depth,
        frame.rgb_u8,
        frame.inverse_depth,
        frame.tissue_mask,
        frame.measured,
        (1.0, depth_weight, cfg.tv_weight, cfg.edge_weight),
        cfg.tv_on_tissue,
    )
    terms = dict(zip(("color", "depth", "tv", "edges"), fused, strict=True))
    if cfg.cover_weight:
        terms["cover"] = cfg.cover_weight * ((1 - out.alpha) * frame.hidden).mean()
    return terms
