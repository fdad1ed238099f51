"""Scoring a scene against its sequence, under a protocol that is printed with the numbers.

A score that cannot be had is listed as skipped, with the reason; nothing ever stands in for it.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from . import metrics
from .atomic import write_json
from .checks import InputError
from .data import Sequence
from .metrics import ScoreUnavailable
from .model.carry import carry_points
from .model.playback import Playback
from .model.scene import Scene
from .types import Frame

Split = Literal["train", "test", "video"]
LOW_PRIOR, LOW_PRIOR_OBSERVATIONS, LOW_OPACITY, LARGE_SCALE_MM = 0.2, 20, 0.01, 40.0
"""Thresholds of the paper's primitive diagnostics."""
FPS_WARM_UP, FPS_RENDERS = 10, 60
MIN_FOLLOWED_POINTS = 1


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

    def save(self, folder: Path) -> None:
        """Write `metrics.json` and `per_frame.json`."""
        write_json(folder / "metrics.json", {k: getattr(self, k) for k in ("protocol", "scores", "skipped")})
        write_json(folder / "per_frame.json", self.per_frame)


@dataclass(frozen=True)
class Rendered:
    """One frame as the scene shows it."""

    rgb_u8: NDArray[np.uint8]
    """(H, W, 3): the protocol scores 8-bit images, as the released code does."""
    depth: NDArray[np.float32]
    """(H, W) sum of weight * z, mm."""


def evaluate(
    scene: Scene,
    sequence: Sequence,
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
    result = Evaluation(_protocol(sequence, split))
    progress("drawing")
    drawn = {frame.index: _draw(scene, frame) for frame in sequence.frames("video")}
    frames = list(sequence.frames(split))
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


def _protocol(sequence: Sequence, split: Split) -> dict[str, Any]:
    return {
        "split": split,
        "split_rule": "test iff (i - 1) % 8 == 0",
        "frames": sequence.indices(split),
        "images": "8-bit round trip; psnr, ssim, lpips and flow on images multiplied by the tissue mask",
        "masks": "masks/ of the sequence, tissue = not tool",
        "depth": "sum of weight * z against measured depth on tissue, mm, mean of per-frame RMSE",
        "flow_error": "consecutive frames of the split; *_adjacent: all adjacent frames of the video",
        "depth_instability_mm": "all adjacent frames of the video",
        "data_fingerprint": sequence.fingerprint(),
    }


def _draw(scene: Scene, frame: Frame) -> Rendered:
    out = scene.render(frame.time, frame.camera)
    return Rendered(metrics.to_uint8(out.color.numpy()), out.depth.numpy())


def _image_scores(result: Evaluation, frames: list[Frame], drawn: dict[int, Rendered]) -> None:
    for frame in frames:
        image, target = drawn[frame.index].rgb_u8 / np.float32(255), frame.rgb
        mask = frame.tissue_mask
        row = {
            "psnr": metrics.psnr(image, target, mask),
            "psnr_tissue": metrics.psnr_tissue(image, target, mask),
            "ssim": metrics.ssim(image, target, mask),
            "depth_rmse_mm": metrics.depth_rmse(drawn[frame.index].depth, frame.depth, mask & frame.depth_valid),
        }
        result.per_frame.append({"index": frame.index, "time": frame.time} | _finite(row))
    for name in ("psnr", "psnr_tissue", "ssim", "depth_rmse_mm"):
        mean = metrics.mean_over_frames([row.get(name, math.nan) for row in result.per_frame])
        reason = "no tissue with measured depth" if name == "depth_rmse_mm" else "no tissue in the split"
        result.add(name, mean, reason)


def _flow_scores(
    result: Evaluation,
    sequence: Sequence,
    frames: list[Frame],
    drawn: dict[int, Rendered],
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
        values = _flow_errors(list(sequence.frames("video")), drawn, metrics.dis_flow())
        result.add("flow_error_dis_adjacent", metrics.mean_over_frames(values), "no two adjacent frames share tissue")
    except ScoreUnavailable as reason:
        result.skipped["flow_error_dis_adjacent"] = str(reason)


def _flow_errors(frames: list[Frame], drawn: dict[int, Rendered], estimator: metrics.FlowEstimator) -> NDArray:
    return metrics.flow_error(
        [drawn[frame.index].rgb_u8 for frame in frames],
        [frame.rgb_u8 for frame in frames],
        [frame.tissue_mask for frame in frames],
        estimator,
    )


def _lpips_scores(
    result: Evaluation, frames: list[Frame], drawn: dict[int, Rendered], networks: bool, weights_dir: Path | None
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


def _depth_instability(result: Evaluation, sequence: Sequence, drawn: dict[int, Rendered]) -> None:
    frames = list(sequence.frames("video"))
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
    result: Evaluation, scene: Scene, sequence: Sequence, frames: list[Frame], drawn: dict[int, Rendered]
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
    result.add("psnr_behind_tool", metrics.mean_over_frames(color), "no true picture behind the tool")
    result.add("depth_rmse_behind_tool_mm", metrics.mean_over_frames(depth), "no true depth behind the tool")
    error = track_error(scene, sequence)
    result.add("track_error_mm", error.mm, "no track is visible in two frames")
    result.add("track_error_px", error.px, "no track is visible in two frames")


def track_error(scene: Scene, sequence: Sequence) -> metrics.TrackError:
    """Error of material points carried by the deformation, over all frames where they are visible.

    Each point starts at its true position in the first frame that shows it; that frame does not count.
    """
    tracks = sequence.truth and sequence.truth.tracks
    if not tracks:
        return metrics.TrackError(math.nan, math.nan)
    followed = tracks.visible.sum(0) > 1
    if followed.sum() < MIN_FOLLOWED_POINTS:
        return metrics.TrackError(math.nan, math.nan)
    points, visible = tracks.points[:, followed].astype(np.float64), tracks.visible[:, followed].copy()
    first = visible.argmax(0)
    columns = np.arange(points.shape[1])
    cameras = scene.cameras
    to_world = np.stack([np.linalg.inv(camera.world_to_camera) for camera in cameras])
    start = np.einsum("pij,pj->pi", to_world[first][:, :3, :3], points[first, columns]) + to_world[first][:, :3, 3]
    times = [i / len(cameras) for i in range(len(cameras))]
    carried = carry_points(scene, start, first, times)
    predicted = np.stack(
        [
            p @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
            for p, camera in zip(carried, cameras, strict=True)
        ]
    )
    visible[first, columns] = False
    return metrics.track_error(predicted, points, visible, cameras[0])


def frames_per_second(scene: Scene, *, cached: bool = False) -> float:
    """Drawing speed over the frames of the sequence in turn: deformation included, input and output excluded.

    Args:
        cached: deform the frames beforehand and draw them from a `Playback`.
    """
    shown = min(len(scene.cameras), FPS_RENDERS)
    playback = Playback(scene)

    def draw(i: int) -> None:
        if cached:
            playback.render(i % shown)
        else:
            scene.render(i % shown / len(scene.cameras))

    for i in range(shown if cached else FPS_WARM_UP):
        draw(i)
    began = clock.perf_counter()
    for i in range(FPS_RENDERS):
        draw(i)
    return FPS_RENDERS / (clock.perf_counter() - began)


def _finite(row: dict[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in row.items() if math.isfinite(value)}
