"""Score the frames of a reconstruction as the evaluation scripts of other papers do, with what makes scores comparable.

Every number stands under the name of its protocol. What a protocol needs and this machine or sequence lacks is a
skipped score with its reason, as everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.checks import InputError
from ...core.config import DataConfig
from ...core.types import Frame
from ...data import FrameSequence, load_sequence
from ...model.method import method_of
from ..context import EXACT, NETWORKS_OFF, EvaluationContext, RenderedFrame, SceneFrames
from ..score import ScoreUnavailable, mean_over_frames
from ..scorers.depth import depth_rmse, depth_rmse_8bit
from ..scorers.image import SquaredErrors, pooled_psnr, squared_errors, ssim, ssim_valid
from ..scorers.lpips import LpipsDistance, lpips_distance
from .table import KEYS, PROTOCOLS, Protocol

NO_TISSUE = "no tissue in the frames"
NO_DEPTH = "no tissue with measured depth"
BACKGROUNDS = {(0.0, 0.0, 0.0): "black", (1.0, 1.0, 1.0): "white"}
NETWORKS = {"alex": "AlexNet", "vgg": "VGG16"}
Load = Callable[[str], LpipsDistance | ScoreUnavailable]


def score_protocols(names: Sequence[str], context: EvaluationContext, reading: DataConfig) -> dict[str, dict[str, Any]]:
    """Score the frames of the split by each protocol.

    Args:
        context: the evaluation whose rendered frames are scored.
        reading: how its sequence was read: other masks of the same folder are read in the same way.
    Returns:
        By name a dict in JSON's types: `title`, `source`, `tags`, `paper`, `differs`, `scores` and `skipped`. `tags` is
        empty where the masks of the protocol are missing, and all scores are skipped.
    """

    @cache
    def load(backbone: str) -> LpipsDistance | ScoreUnavailable:
        """Each classifier once, for all protocols; why not where it cannot be had."""
        if not context.networks:
            return ScoreUnavailable(NETWORKS_OFF)
        try:  # VGG16 has 530 MB, too much to download unasked
            return lpips_distance(backbone, context.weights_dir, download=backbone == "alex")
        except ScoreUnavailable as reason:
            return reason

    return {name: _score(PROTOCOLS.load(name), context, reading, load) for name in names}


def _score(about: Protocol, context: EvaluationContext, reading: DataConfig, load: Load) -> dict[str, Any]:
    result: dict[str, Any] = {"title": about.title, "source": about.source, "tags": {}, "paper": dict(about.paper)}
    result |= {"differs": list(about.differs), "scores": {}, "skipped": {}}
    skipped = result["skipped"]
    structure = ssim_valid if about.ssim_valid else ssim
    measures: dict[str, Callable[[_View], float]] = {"ssim": lambda view: structure(view.image, view.target, view.mask)}
    network = load(about.lpips)
    if isinstance(network, ScoreUnavailable):
        skipped["lpips"] = str(network)
    else:
        distance = replace(network, lowest=about.lpips_lowest)
        measures["lpips"] = lambda view: distance(view.image, view.target, view.mask)
    if about.depth:
        measures["depth_rmse_mm" if about.depth.startswith("mm") else "depth_rmse_8bit"] = _depth_by(about)
    try:
        masks = masks_of(about, context.sequence, reading)
    except ScoreUnavailable as reason:
        result["skipped"] = dict.fromkeys(["psnr", *measures, *skipped], str(reason))
        return result
    indices = [i for i in context.sequence.indices(context.split) if not (about.skips_first and i == 0)]
    result["tags"] = tags_of(about, context, indices, masks.mask_folder, reading.shrink)
    errors: list[SquaredErrors] = []
    counts: list[int] = []
    values: dict[str, list[float]] = {name: [] for name in measures}
    for index in indices:
        view = _view(about, masks.frame(index), context.rendered[index], reading.shrink)
        errors.append(squared_errors(view.image, view.target, view.mask))
        counts.append(int(view.measured.sum()))
        for name in [name for name in measures if name not in skipped]:
            try:
                values[name].append(measures[name](view))
            except ScoreUnavailable as reason:
                skipped[name] = str(reason)
    together = [errors] if about.pooled else [[error] for error in errors]
    found = {"psnr": mean_over_frames(pooled_psnr(group, over_frame=about.over_frame) for group in together)}
    found |= {name: mean_over_frames(values[name]) for name in measures if name not in skipped}
    if about.depth == "mm, pooled" and "depth_rmse_mm" in found:
        totals = [n * error**2 if n else 0.0 for n, error in zip(counts, values["depth_rmse_mm"], strict=True)]
        found["depth_rmse_mm"] = float(np.sqrt(sum(totals) / sum(counts))) if sum(counts) else math.nan
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


def _depth_by(about: Protocol) -> Callable[[_View], float]:
    """The depth error of one frame; NaN where nothing was measured."""

    def in_mm(view: _View) -> float:
        rows = len(view.mask)
        return depth_rmse(view.rendered.depth[:rows], view.frame.depth[:rows], view.measured)

    def in_8_bits(view: _View) -> float:
        rows, frame = len(view.mask), view.frame
        depth = view.rendered.depth[:rows]
        if not frame.depth_valid.any():
            return math.nan
        # The readers of these programs set missing depth to the nearest measured one, and score it.
        target = np.where(frame.depth_valid, frame.depth, frame.depth[frame.depth_valid].min())[:rows]
        if about.depth == "8-bit, tissue":
            return depth_rmse_8bit(depth, target, view.mask, int(view.mask.sum()))
        return depth_rmse_8bit(depth, target, view.mask & (np.fmod(target, 256) >= 1), view.mask.size)

    return in_mm if about.depth.startswith("mm") else in_8_bits


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


def tags_of(
    protocol: Protocol, context: EvaluationContext, indices: Sequence[int], mask_folder: str, shrink: int
) -> dict[str, str]:
    """The tags of one evaluation under a protocol, by the names of `KEYS`.

    Args:
        indices: the frames that are scored.
        mask_folder: `FrameSequence.mask_folder` of the masks in use.
        shrink: what the size of the frames was divided by.
    """
    made, is_scene = context.reconstruction, isinstance(context.reconstruction, SceneFrames)
    seen, total = len({*indices} - {*context.sequence.indices("test")}), len(indices)
    height = context.sequence.camera(0).height
    kept, masked = rows_of(protocol, height, shrink)
    rows = f"0..{kept - 1} of {height}" if kept < height else f"all {height}"
    without = protocol.skips_first and 0 in context.sequence.indices(context.split)
    phase = context.sequence.test_phase
    values = {
        "split": f"{context.split}{f' {phase}/8' if phase else ''}, {total} {'without 0' if without else 'frames'}",
        "saw_test_frames": (f"yes: {seen} of {total}" if seen else "no") if is_scene else "not known",
        "mask_folder": mask_folder or "none: by the reader",
        "rows": rows + (f", {masked} masked" if masked else ""),
        "background": BACKGROUNDS[method_of(made.scene.config).background] if is_scene else "of the images",
        "color": "8 bits" if protocol.rounded else "not rounded",
        "psnr_over": "all pixels" if protocol.over_frame else "tissue pixels",
        "psnr_mean": "all frames together" if protocol.pooled else "mean of frames",
        "ssim": "complete windows" if protocol.ssim_valid else "zeros around",
        "lpips": f"{NETWORKS[protocol.lpips]}, [{protocol.lpips_lowest}, 1]",
        "depth": protocol.depth or "not scored",
    }
    return {name: values[name] for name in KEYS}


def rows_of(protocol: Protocol, height: int, shrink: int) -> tuple[int, int]:
    """How many rows from the top are scored, and how many of these at the bottom count as tool.

    Args:
        height: of a frame as it is read, px.
        shrink: what its size was divided by. Rows of the table are those of full size.
    """
    kept = min(height, protocol.kept_rows // shrink) if protocol.kept_rows else height
    return kept, min(kept, -(-protocol.masked_rows // shrink))
