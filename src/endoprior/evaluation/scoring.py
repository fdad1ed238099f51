"""Scoring a scene against its sequence, under a protocol that is printed with the numbers.

A score that cannot be had is listed as skipped, with the reason; nothing ever stands in for it.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError
from ..core.config import DataConfig
from ..core.types import Frame
from ..data import FrameSequence
from ..model.playback import Playback
from ..model.scene import Scene
from ..system.atomic import write_json
from ..system.devices import name_of, wait_for
from ..system.memory import BoundedCache, cache_bytes
from . import metrics
from .metrics import ScoreUnavailable
from .truth import track_end_error_mm, track_scores

Split = Literal["train", "test", "video"]
LOW_PRIOR, LOW_PRIOR_OBSERVATIONS, LOW_OPACITY, LARGE_SCALE_MM = 0.2, 20, 0.01, 40.0
"""Thresholds of the paper's primitive diagnostics."""
BAD_FRAME_DB = 3.0
"""A frame this far below the median PSNR of its split was not explained: something happened there."""
FPS_WARM_UP, FPS_RENDERS = 10, 60
EXACT = "infinite: the frames that count equal the truth to the last bit"
"""Why there is no PSNR where every frame is drawn without any error, black ones for example."""


@dataclass
class Evaluation:
    """Scores of one scene on one split."""

    protocol: dict[str, Any]
    scores: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    per_frame: list[dict[str, Any]] = field(default_factory=list)

    def add(self, name: str, value: float, reason_if_nan: str) -> None:
        """Record a score, or why it has no value."""
        if math.isfinite(value):
            self.scores[name] = float(value)
        else:
            self.skipped[name] = reason_if_nan

    def badly_explained(self) -> list[int]:
        """Frames whose `psnr_tissue` lies more than `BAD_FRAME_DB` below the median of the split."""
        scored = [(row["index"], row["psnr_tissue"]) for row in self.per_frame if row.get("psnr_tissue") is not None]
        usual = float(np.median([value for _, value in scored])) if scored else 0.0
        return [index for index, value in scored if value < usual - BAD_FRAME_DB]

    def save(self, folder: Path) -> None:
        """Write `metrics.json` and `per_frame.json`."""
        write_json(folder / "metrics.json", {k: getattr(self, k) for k in ("protocol", "scores", "skipped")})
        write_json(folder / "per_frame.json", self.per_frame)


class Drawn:
    """Frames as the scene shows them, by index: drawn when first asked for, kept as memory allows."""

    def __init__(self, scene: Scene, sequence: FrameSequence, split: Split) -> None:
        self._scene, self._sequence = scene, sequence
        self._scored = set(sequence.indices(split))
        self._kept: BoundedCache[Rendered] = BoundedCache(cache_bytes(), lambda rendered: rendered.nbytes)

    def __getitem__(self, index: int) -> Rendered:
        def draw() -> Rendered:
            return _draw(self._scene, self._sequence.frame(index), index in self._scored)

        return self._kept.get(index, draw)


@dataclass(frozen=True)
class Rendered:
    """One frame as the scene shows it."""

    color: NDArray[np.float32] | None
    """(H, W, 3) in [0, 1], as it was drawn; kept for the scored frames only."""
    rgb_u8: NDArray[np.uint8]
    """(H, W, 3): the protocol scores 8-bit images, as the released code does."""
    depth: NDArray[np.float32]
    """(H, W) sum of weight * z, mm."""

    @property
    def nbytes(self) -> int:
        """Memory it takes."""
        return sum(array.nbytes for array in (self.color, self.rgb_u8, self.depth) if array is not None)


def evaluate(
    scene: Scene,
    sequence: FrameSequence,
    split: Split = "test",
    *,
    networks: bool = True,
    weights_dir: Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Evaluation:
    """Score `scene` on a split of `sequence`.

    Args:
        networks: also try RAFT and LPIPS; their weights are looked for in `weights_dir`, then in torch's cache, then
            downloaded.
    Raises:
        InputError: the sequence is not the one the scene was trained on (number of frames or size differ).
    """
    if len(sequence) != len(scene.cameras):
        raise InputError(
            f"{sequence.path}: expected the {len(scene.cameras)} frames the scene was trained on; got {len(sequence)}. "
            "Pass the same sequence."
        )
    result = Evaluation(_protocol(sequence, split, scene))
    progress("drawing")
    drawn, frames = Drawn(scene, sequence, split), sequence.frames(split)
    progress("images and depth")
    _image_scores(result, frames, drawn)
    progress("flow")
    _flow_scores(result, sequence, frames, drawn, networks, weights_dir)
    _lpips_scores(result, frames, drawn, networks, weights_dir)
    _depth_instability(result, sequence, drawn)
    _primitive_counts(result, scene)
    if sequence.truth is not None:
        progress("truth")
        _truth_scores(result, scene, sequence, frames, drawn)
    progress("speed")
    result.scores["fps"] = frames_per_second(scene)
    result.scores["fps_cached"] = frames_per_second(scene, cached=True)
    return result


def scored_data(trained: DataConfig) -> DataConfig:
    """How frames are read to score a scene: those it was trained on, depth as it was measured."""
    usual = DataConfig()
    return replace(
        trained,
        depth_clip_low_percentile=usual.depth_clip_low_percentile,
        depth_clip_high_percentile=usual.depth_clip_high_percentile,
        lift_missing_depth=usual.lift_missing_depth,
    )


def _protocol(sequence: FrameSequence, split: Split, scene: Scene) -> dict[str, Any]:
    data = scene.config.data
    relative = "; relative: the depth's scale is assumed, its mm are not mm" if sequence.depth_is_relative else ""
    return {
        "split": split,
        "split_rule": "test iff (i - 1) % 8 == 0",
        "frames": sequence.indices(split),
        "images": "8-bit round trip; psnr, ssim, lpips and flow on images multiplied by the tissue mask",
        "shrink": data.shrink,
        "masks": f"{'gt_masks/' if data.use_gt_masks else 'masks/'} of the sequence, tissue = not tool",
        "strict_*": "color as drawn, not rounded to 8 bits; tissue pixels only; flow: flow_error_dis_adjacent",
        "depth_rmse_endogaussian": "8-bit depths that wrap, only to compare with that paper's tables",
        "depth": "sum of weight * z against measured depth on tissue, mm, mean of per-frame RMSE" + relative,
        "flow_error": "consecutive frames of the split; *_adjacent: all adjacent frames of the video",
        "depth_instability_mm": "all adjacent frames of the video",
        "data_fingerprint": sequence.fingerprint(),
        "drawn_by": scene.backend,
        "fps": f"{FPS_RENDERS} pictures of the sequence's frames, one after the other; {name_of(scene.device)}",
    }


def _draw(scene: Scene, frame: Frame, scored: bool) -> Rendered:
    out = scene.render(frame.time, frame.camera)
    color = out.color.cpu().numpy()
    return Rendered(np.clip(color, 0, 1) if scored else None, metrics.to_uint8(color), out.depth.cpu().numpy())


def _image_scores(result: Evaluation, frames: Sequence[Frame], drawn: Drawn) -> None:
    rows = []
    for frame in frames:
        image, target = drawn[frame.index].rgb_u8 / np.float32(255), frame.rgb
        mask = frame.tissue_mask
        row = {
            "psnr": metrics.psnr(image, target, mask),
            "psnr_tissue": metrics.psnr_tissue(image, target, mask),
            "ssim": metrics.ssim(image, target, mask),
            "depth_rmse_mm": metrics.depth_rmse(drawn[frame.index].depth, frame.depth, mask & frame.depth_valid),
            "depth_rmse_endogaussian": metrics.depth_rmse_endogaussian(drawn[frame.index].depth, frame.depth, mask),
            "strict_psnr": metrics.psnr_tissue(drawn[frame.index].color, target, mask),
            "strict_ssim": metrics.ssim_tissue(drawn[frame.index].color, target, mask),
        }
        rows.append(row)
        result.per_frame.append({"index": frame.index, "time": frame.time} | _finite(row))
    for name in rows[0]:
        values = [row[name] for row in rows]
        reason = "no tissue with measured depth" if name.startswith("depth") else "no tissue in the split"
        result.add(name, metrics.mean_over_frames(values), EXACT if math.inf in values else reason)


def _flow_scores(
    result: Evaluation,
    sequence: FrameSequence,
    frames: Sequence[Frame],
    drawn: Drawn,
    networks: bool,
    weights_dir: Path | None,
) -> None:
    makers: dict[str, Callable[[], metrics.FlowEstimator]] = {"flow_error_dis": metrics.dis_flow}
    if networks:
        makers["flow_error"] = lambda: metrics.raft_flow("large", weights_dir)
        makers["flow_error_raft_small"] = lambda: metrics.raft_flow("small", weights_dir, download=False)
    else:
        result.skipped["flow_error"] = "network scores were not asked for"
    for name, make in makers.items():
        try:
            values = _flow_errors(frames, drawn, make())
        except ScoreUnavailable as reason:
            result.skipped[name] = str(reason)
            continue
        result.add(name, metrics.mean_over_frames(values), "no two consecutive frames share tissue")
    try:
        values = _flow_errors(sequence.frames("video"), drawn, metrics.dis_flow())
        result.add("flow_error_dis_adjacent", metrics.mean_over_frames(values), "no two adjacent frames share tissue")
    except ScoreUnavailable as reason:
        result.skipped["flow_error_dis_adjacent"] = str(reason)


def _flow_errors(frames: Sequence[Frame], drawn: Drawn, estimator: metrics.FlowEstimator) -> list[float]:
    """One error for each pair of neighbors; two frames at a time, so that a long film needs no more memory."""
    errors = []
    for pair in pairwise(frames):
        shown, true = [drawn[frame.index].rgb_u8 for frame in pair], [frame.rgb_u8 for frame in pair]
        errors += list(metrics.flow_error(shown, true, [frame.tissue_mask for frame in pair], estimator))
    return errors


def _lpips_scores(
    result: Evaluation, frames: Sequence[Frame], drawn: Drawn, networks: bool, weights_dir: Path | None
) -> None:
    if not networks:
        result.skipped["lpips"] = "network scores were not asked for"
        return
    for name, backbone in (("lpips", "alex"), ("lpips_squeeze", "squeeze")):
        try:
            distance = metrics.lpips_distance(backbone, weights_dir, download=backbone == "alex")
            values = [distance(drawn[f.index].rgb_u8 / np.float32(255), f.rgb, f.tissue_mask) for f in frames]
        except ScoreUnavailable as reason:
            result.skipped[name] = str(reason)
            continue
        result.add(name, metrics.mean_over_frames(values), "no tissue in the split")


def _depth_instability(result: Evaluation, sequence: FrameSequence, drawn: Drawn) -> None:
    frames = sequence.frames("video")
    values = [
        metrics.depth_instability(drawn[a.index].depth, drawn[b.index].depth, a.tissue_mask, b.tissue_mask)
        for a, b in pairwise(frames)
    ]
    result.add("depth_instability_mm", metrics.mean_over_frames(values), "no two adjacent frames share drawn tissue")


def _primitive_counts(result: Evaluation, scene: Scene) -> None:
    seen = scene.num_valid >= LOW_PRIOR_OBSERVATIONS
    result.scores |= {
        "num_gaussians": len(scene),
        "num_low_prior": int((seen & (scene.prior_score < LOW_PRIOR)).sum()),
        "num_low_opacity": int((scene.gaussians.opacities < LOW_OPACITY).sum()),
        "num_large_scale": int((scene.gaussians.scales.amax(-1) > LARGE_SCALE_MM).sum()),
    }


def _truth_scores(
    result: Evaluation, scene: Scene, sequence: FrameSequence, frames: Sequence[Frame], drawn: Drawn
) -> None:
    truth = sequence.truth
    color, depth = [], []
    for frame in frames:
        image = drawn[frame.index].rgb_u8 / np.float32(255)
        tissue, exact = truth.tissue(frame.index), truth.depth(frame.index)
        if tissue is not None:
            color.append(metrics.psnr_behind_tool(image, tissue / np.float32(255), frame.tissue_mask))
        if exact is not None:
            depth.append(metrics.depth_rmse(drawn[frame.index].depth, exact, ~frame.tissue_mask & (exact > 0)))
    reason = EXACT if math.inf in color else "no true picture behind the tool"
    result.add("psnr_behind_tool", metrics.mean_over_frames(color), reason)
    result.add("depth_rmse_behind_tool_mm", metrics.mean_over_frames(depth), "no true depth behind the tool")
    if sequence.truth.tracks and not sequence.truth.tracks.paired:
        result.add("track_end_error_mm", track_end_error_mm(scene, sequence), "no point has depth at start and end")
    for name, value in track_scores(scene, sequence).items():
        result.add(name, value, "no track is visible in two frames")


def frames_per_second(scene: Scene, *, cached: bool = False) -> float:
    """Drawing speed over the frames of the sequence in turn: deformation included, input and output excluded.

    Args:
        cached: deform the frames beforehand and draw them from a `Playback`.
    """
    shown = min(len(scene.cameras), FPS_RENDERS)
    playback = Playback(scene) if cached else None

    def draw(i: int) -> None:
        if playback:
            playback.render(i % shown)
        else:
            scene.render(i % shown / len(scene.cameras))

    for i in range(shown if cached else FPS_WARM_UP):
        draw(i)
    wait_for(scene.device)
    began = clock.perf_counter()
    for i in range(FPS_RENDERS):
        draw(i)
    wait_for(scene.device)
    return FPS_RENDERS / (clock.perf_counter() - began)


def _finite(row: dict[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in row.items() if math.isfinite(value)}
