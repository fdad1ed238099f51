"""Score the frames of a reconstruction as the evaluation scripts of other papers do, with tags to compare them by."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
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
from ..scorers.lpips import Backbone, LpipsDistance, lpips_distance
from .table import KEYS, PROTOCOLS, Protocol

NO_TISSUE = "no tissue in the frames"
NO_DEPTH = "no tissue with measured depth"
BACKGROUNDS = {(0.0, 0.0, 0.0): "black", (1.0, 1.0, 1.0): "white"}
NETWORKS = {"alex": "AlexNet", "vgg": "VGG16"}
Load = Callable[[Backbone], LpipsDistance | ScoreUnavailable]
Images = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]
"""(H, W, 3) rendered and true color in [0, 1], (H, W) tissue mask, as a script compares them: cropped and masked."""


def score_protocols(names: Sequence[str], context: EvaluationContext, reading: DataConfig) -> dict[str, dict[str, Any]]:
    """Score the frames by each protocol: `title`, `source`, `tags`, `paper`, `differs`, `scores`, `skipped` by its
    name.

    `reading` says how the sequence was read: other masks of the same folder are read in the same way. Where the masks
    of a protocol are missing, `tags` is empty and all scores are skipped.
    """

    @cache
    def load(backbone: Backbone) -> LpipsDistance | ScoreUnavailable:
        """Each classifier once, for all protocols; why not where it cannot be had."""
        if not context.networks:
            return ScoreUnavailable(NETWORKS_OFF)
        try:  # VGG16 has 530 MB, too much to download unasked
            return lpips_distance(backbone, context.weights_dir, download=context.download and backbone == "alex")
        except ScoreUnavailable as reason:
            return reason

    return {name: _score(PROTOCOLS.load(name), context, reading, load) for name in names}


def _score(about: Protocol, context: EvaluationContext, reading: DataConfig, load: Load) -> dict[str, Any]:
    skipped: dict[str, str] = {}
    result: dict[str, Any] = {"title": about.title, "source": about.source, "tags": {}, "paper": dict(about.paper)}
    result |= {"differs": list(about.differs), "scores": {}, "skipped": skipped}
    measures: dict[str, Callable[..., float]] = {"ssim": ssim_valid if about.ssim_valid else ssim}
    network = load(about.lpips)
    if isinstance(network, ScoreUnavailable):
        skipped["lpips"] = str(network)
    else:
        measures["lpips"] = replace(network, lowest=about.lpips_lowest)
    depth_name = "depth_rmse_mm" if about.depth.startswith("mm") else "depth_rmse_8bit"
    try:
        masks = masks_of(about, context.sequence, reading)
    except ScoreUnavailable as reason:
        names = ["psnr", *measures, *([depth_name] if about.depth else []), *skipped]
        return result | {"skipped": dict.fromkeys(names, str(reason))}
    indices = [i for i in context.sequence.indices(context.split) if not (about.skips_first and i == 0)]
    result["tags"] = tags_of(about, context, indices, masks.mask_folder, reading.shrink)
    errors: list[SquaredErrors] = []
    counts: list[int] = []
    values: dict[str, list[float]] = {name: [] for name in (*measures, *([depth_name] if about.depth else []))}
    for index in indices:
        frame, rendered = masks.frame(index), context.rendered[index]
        images = _images(about, frame, rendered, reading.shrink)
        errors.append(squared_errors(*images))
        counts.append(int((images[2] & frame.depth_valid[: len(images[2])]).sum()))
        for name in [name for name in values if name not in skipped]:
            try:
                depth_or_image = measures[name](*images) if name in measures else _depth(about, frame, rendered, images)
                values[name].append(depth_or_image)
            except ScoreUnavailable as reason:
                skipped[name] = str(reason)
    together = [errors] if about.pooled else [[error] for error in errors]
    found = {"psnr": mean_over_frames(pooled_psnr(group, over_frame=about.over_frame) for group in together)}
    found |= {name: mean_over_frames(values[name]) for name in values if name not in skipped}
    if about.depth == "mm, pooled" and "depth_rmse_mm" in found:
        totals = [n * error**2 if n else 0.0 for n, error in zip(counts, values["depth_rmse_mm"], strict=True)]
        found["depth_rmse_mm"] = float(np.sqrt(sum(totals) / sum(counts))) if sum(counts) else math.nan
    equal = not any(error.total for error in errors) and any(error.of_tissue for error in errors)
    for name, value in found.items():
        if math.isfinite(value):
            result["scores"][name] = value
        else:
            skipped[name] = EXACT if equal and name == "psnr" else NO_DEPTH if "depth" in name else NO_TISSUE
    return result


def _images(about: Protocol, frame: Frame, rendered: RenderedFrame, shrink: int) -> Images:
    kept, masked = rows_of(about, frame.tissue_mask.shape[0], shrink)
    mask = frame.tissue_mask[:kept].copy()
    mask[kept - masked :] = False
    return (rendered.rgb if about.rounded else rendered.color)[:kept], frame.rgb[:kept], mask


def _depth(about: Protocol, frame: Frame, rendered: RenderedFrame, images: Images) -> float:
    """The depth error of one frame; NaN where nothing was measured."""
    mask = images[2]
    rows = len(mask)
    depth = rendered.depth[:rows]
    if about.depth.startswith("mm"):
        return depth_rmse(depth, frame.depth[:rows], mask & frame.depth_valid[:rows])
    if not frame.depth_valid.any():
        return math.nan
    # The readers of these programs set missing depth to the nearest measured one, and score it.
    target = np.where(frame.depth_valid, frame.depth, frame.depth[frame.depth_valid].min())[:rows]
    if about.depth == "8-bit, tissue":
        return depth_rmse_8bit(depth, target, mask, int(mask.sum()))
    return depth_rmse_8bit(depth, target, mask & (np.fmod(target, 256) >= 1), mask.size)


def masks_of(protocol: Protocol, sequence: FrameSequence, reading: DataConfig) -> FrameSequence:
    """The sequence with the masks that a protocol reads, or the same folder read again; else ScoreUnavailable."""
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
    """The tags of one evaluation of frames `indices` under a protocol, by the names of `KEYS`. `mask_folder` is that of
    the masks in use; the size of the frames was divided by `shrink`.
    """
    made = context.reconstruction
    scene = made.scene if isinstance(made, SceneFrames) else None
    seen, total = len({*indices} - {*context.sequence.indices("test")}), len(indices)
    height = context.sequence.camera(0).height
    kept, masked = rows_of(protocol, height, shrink)
    rows = f"0..{kept - 1} of {height}" if kept < height else f"all {height}"
    without = protocol.skips_first and 0 in context.sequence.indices(context.split)
    phase = context.sequence.test_phase
    values = {
        "split": f"{context.split}{f' {phase}/8' if phase else ''}, {total} {'without 0' if without else 'frames'}",
        "saw_test_frames": (f"yes: {seen} of {total}" if seen else "no") if scene else "not known",
        "mask_folder": mask_folder or "none: by the reader",
        "rows": rows + (f", {masked} masked" if masked else ""),
        "background": BACKGROUNDS[method_of(scene.config).background] if scene else "of the images",
        "color": "8 bits" if protocol.rounded else "not rounded",
        "psnr_over": "all pixels" if protocol.over_frame else "tissue pixels",
        "psnr_mean": "all frames together" if protocol.pooled else "mean of frames",
        "ssim": "complete windows" if protocol.ssim_valid else "zeros around",
        "lpips": f"{NETWORKS[protocol.lpips]}, [{protocol.lpips_lowest}, 1]",
        "depth": protocol.depth or "not scored",
    }
    return {name: values[name] for name in KEYS}


def rows_of(protocol: Protocol, height: int, shrink: int) -> tuple[int, int]:
    """How many rows from the top are scored, and how many of these at the bottom count as tool, of frames of this
    height, px. The size was divided by `shrink`; rows of the table are those of full size.
    """
    kept = min(height, protocol.kept_rows // shrink) if protocol.kept_rows else height
    return kept, min(kept, -(-protocol.masked_rows // shrink))
