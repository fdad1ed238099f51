"""Score the frames of a reconstruction as the evaluation scripts of other papers do.

Every number stands under the name of its protocol. What a protocol needs and this machine or sequence lacks is a
skipped score with its reason, as everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...core.checks import InputError
from ...core.config import DataConfig
from ...core.types import Frame
from ...data import FrameSequence, load_sequence
from .. import metrics
from ..context import EXACT, NETWORKS_OFF, EvaluationContext
from ..metrics import ScoreUnavailable
from ..rendered import RenderedFrame
from .table import PROTOCOLS, Protocol
from .tags import rows_of, tags_of

NO_TISSUE = "no tissue in the frames"
NO_DEPTH = "no tissue with measured depth"
Load = Callable[[str, int], metrics.LpipsDistance]


def score_protocols(names: Sequence[str], context: EvaluationContext, reading: DataConfig) -> dict[str, dict[str, Any]]:
    """Score the frames of the split by each protocol.

    Args:
        context: the evaluation whose rendered frames are scored.
        reading: how its sequence was read: other masks of the same folder are read in the same way.
    Returns:
        By name a dict in JSON's types: `title`, `source`, `tags`, `paper`, `differs`, `scores` and `skipped`. `tags` is
        empty where the masks of the protocol are missing, and all scores are skipped.
    """
    load = _loader(context.networks, context.weights_dir)
    return {name: _score(PROTOCOLS.load(name), context, reading, load) for name in names}


def _score(about: Protocol, context: EvaluationContext, reading: DataConfig, load: Load) -> dict[str, Any]:
    result: dict[str, Any] = {"title": about.title, "source": about.source, "tags": {}, "paper": dict(about.paper)}
    result |= {"differs": list(about.differs), "scores": {}, "skipped": {}}
    skipped = result["skipped"]
    measures: dict[str, Callable[[_View], float]] = {"ssim": _ssim_by(about)}
    try:
        measures["lpips"] = _lpips_by(load(about.lpips, about.lpips_lowest))
    except ScoreUnavailable as reason:
        skipped["lpips"] = str(reason)
    if about.depth:
        measures["depth_rmse_mm" if about.depth.startswith("mm") else "depth_rmse_8bit"] = _depth_by(about)
    try:
        masks = masks_of(about, context.sequence, reading)
    except ScoreUnavailable as reason:
        result["skipped"] = dict.fromkeys(["psnr", *measures, *skipped], str(reason))
        return result
    indices = [i for i in context.sequence.indices(context.split) if not (about.skips_first and i == 0)]
    result["tags"] = tags_of(about, context, indices, masks.mask_folder, reading.shrink)
    errors: list[metrics.SquaredErrors] = []
    counts: list[int] = []
    values: dict[str, list[float]] = {name: [] for name in measures}
    for index in indices:
        view = _view(about, masks.frame(index), context.rendered[index], reading.shrink)
        errors.append(metrics.squared_errors(view.image, view.target, view.mask))
        counts.append(int(view.measured.sum()))
        for name in [name for name in measures if name not in skipped]:
            try:
                values[name].append(measures[name](view))
            except ScoreUnavailable as reason:
                skipped[name] = str(reason)
    found = {"psnr": _psnr(about, errors)}
    found |= {name: metrics.mean_over_frames(values[name]) for name in measures if name not in skipped}
    if about.depth == "mm, pooled" and "depth_rmse_mm" in found:
        totals = [n * error**2 if n else 0.0 for n, error in zip(counts, values["depth_rmse_mm"], strict=True)]
        found["depth_rmse_mm"] = metrics.pooled_rmse(totals, counts)
    for name, value in found.items():
        if math.isfinite(value):
            result["scores"][name] = value
        else:
            equal = not any(error.total for error in errors) and any(error.of_tissue for error in errors)
            skipped[name] = EXACT if equal and name == "psnr" else NO_DEPTH if "depth" in name else NO_TISSUE
    return result


@dataclass(frozen=True)
class _View:
    """One frame as a script compares it: cropped, masked and rounded by its rules."""

    image: NDArray[np.float32]
    """(H, W, 3) rendered color in [0, 1]."""
    target: NDArray[np.float32]
    """(H, W, 3) true color in [0, 1]."""
    mask: NDArray[np.bool_]
    """(H, W) True = tissue."""
    measured: NDArray[np.bool_]
    """(H, W) True = tissue with measured depth."""
    frame: Frame
    """For its depth; not cropped."""
    rendered: RenderedFrame
    """For its depth; not cropped."""


def _view(about: Protocol, frame: Frame, rendered: RenderedFrame, shrink: int) -> _View:
    kept, masked = rows_of(about, frame.tissue_mask.shape[0], shrink)
    mask = frame.tissue_mask[:kept].copy()
    mask[kept - masked :] = False
    image = rendered.rgb if about.rounded else rendered.color
    return _View(image[:kept], frame.rgb[:kept], mask, mask & frame.depth_valid[:kept], frame, rendered)


def _psnr(about: Protocol, errors: Sequence[metrics.SquaredErrors]) -> float:
    if about.pooled:
        return metrics.pooled_psnr(errors, over_frame=about.over_frame)
    return metrics.mean_over_frames(metrics.pooled_psnr([error], over_frame=about.over_frame) for error in errors)


def _ssim_by(about: Protocol) -> Callable[[_View], float]:
    ssim = metrics.ssim_valid if about.ssim_valid else metrics.ssim
    return lambda view: ssim(view.image, view.target, view.mask)


def _lpips_by(distance: metrics.LpipsDistance) -> Callable[[_View], float]:
    return lambda view: distance(view.image, view.target, view.mask)


def _depth_by(about: Protocol) -> Callable[[_View], float]:
    """The depth error of one frame; NaN where nothing was measured."""

    def in_mm(view: _View) -> float:
        rows = len(view.mask)
        return metrics.depth_rmse(view.rendered.depth[:rows], view.frame.depth[:rows], view.measured)

    def in_8_bits(view: _View) -> float:
        rows, frame = len(view.mask), view.frame
        depth = view.rendered.depth[:rows]
        if not frame.depth_valid.any():
            return math.nan
        # The readers of these programs set missing depth to the nearest measured one, and score it.
        target = np.where(frame.depth_valid, frame.depth, frame.depth[frame.depth_valid].min())[:rows]
        if about.depth == "8-bit, tissue":
            return metrics.depth_rmse_8bit(depth, target, view.mask, int(view.mask.sum()))
        return metrics.depth_rmse_8bit(depth, target, view.mask & (np.fmod(target, 256) >= 1), view.mask.size)

    return in_mm if about.depth.startswith("mm") else in_8_bits


def _loader(networks: bool, weights_dir: Path | None) -> Load:
    """Loads each classifier once, for all protocols; ScoreUnavailable each time where it cannot be had."""
    known: dict[str, metrics.LpipsDistance | ScoreUnavailable] = {}

    def load(backbone: Literal["alex", "vgg"], lowest: Literal[-1, 0]) -> metrics.LpipsDistance:
        if not networks:
            raise ScoreUnavailable(NETWORKS_OFF)
        if backbone not in known:
            try:  # VGG16 has 530 MB, too much to download unasked
                known[backbone] = metrics.lpips_distance(backbone, weights_dir, download=backbone == "alex")
            except ScoreUnavailable as reason:
                known[backbone] = reason
        found = known[backbone]
        if isinstance(found, ScoreUnavailable):
            raise found
        return replace(found, lowest=lowest)

    return load


def masks_of(protocol: Protocol, sequence: FrameSequence, reading: DataConfig) -> FrameSequence:
    """The sequence with the masks that a protocol reads: itself, or the same folder read again.

    Raises:
        ScoreUnavailable: there are no such masks.
    """
    has_own = (sequence.path / "gt_masks").is_dir()
    if protocol.masks == "gt_masks" and not has_own:
        raise ScoreUnavailable("needs tool masks in gt_masks/, and the sequence has no such folder")
    wanted = has_own and protocol.masks != "masks"
    if sequence.mask_folder == ("gt_masks" if wanted else "masks"):
        return sequence
    if not wanted and not (sequence.path / "masks").is_dir():
        if sequence.mask_folder:
            raise ScoreUnavailable("needs masks in masks/, and the sequence has no such folder")
        return sequence  # a layout without a folder of masks: tissue is what its reader says
    try:
        again = load_sequence(sequence.path, replace(reading, use_gt_masks=wanted))
    except InputError as error:
        raise ScoreUnavailable(f"other masks cannot be read: {error}") from error
    if len(again) != len(sequence):
        raise ScoreUnavailable(f"needs other masks of {len(sequence)} frames; {sequence.path} has {len(again)}")
    return again
