"""What a model is worth beside simple references made from the video alone; what the verdict on a run rests on.

A number of dB says little of a video that was never modelled before: how hard it is, the references tell. `P` points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.geometry import back_project, project
from ...core.ranges import evenly_spaced
from ...core.types import Camera, Frame
from ...data import FrameList, FrameSequence
from ...footage.alignment import align
from ...footage.image_operations import Mask
from ...footage.keypoints import track_points
from ...footage.optical_flow import MIN_SIZE_PX, fine_flow, fine_shrink, fixed_in_image, gray_for_flow
from ...model.carry import carry_points
from ...model.scene import Scene
from ...model.surface import depth_at, project_visible, render_surface, shown_pixels
from ...system.parallel import frame_threads
from ..context import EvaluationContext
from ..score import Score, ScoreUnavailable
from .image import psnr_tissue

SCORES = (
    Score(
        "gain_over_flow", "above the moved frame", "dB", True, 2,
        "Tissue PSNR minus that of the nearest training frame, moved by optical flow (DIS) to the held-out one.",
        compare="absolute", group="image", in_summary=False,
    ),
    Score(
        "gain_over_mean", "above the mean image", "dB", True, 2,
        "Tissue PSNR minus that of the mean of all training frames.",
        compare="absolute", group="image", in_summary=False,
    ),
    Score(
        "slip_px", "slip against the flow", "px", False, 2,
        "Median distance, after 12 frames, between where the scene and where chained flow carries tissue; 640 px wide.",
        group="motion", in_summary=False,
    ),
    Score(
        "depth_triangulated_error", "depth against triangulation", "", False, 3,
        "Median relative difference between rendered depth and that of points triangulated with the scene's cameras.",
        group="depth", in_summary=False,
    ),
    Score(
        "depth_relief", "depth relief against triangulation", "", True, 2,
        "Correlation, within a frame, of the logarithms of rendered and triangulated depth; flat depth has none.",
        group="depth", in_summary=False,
    ),
)  # fmt: skip
BYTES_PER_PX = 60  # memory in which a thread follows a frame, bytes for each px
MEAN_FRAMES = 60  # training frames in the mean image
STARTS, AHEAD, GRID = 6, 12, 16
"""Frames from which points are followed, for so many frames, and the number of points along the wider side."""
HALF = np.float32(0.5)  # OpenCV counts pixels from the center of the first one, we from its edge
REFERENCE_WIDTH_PX = 640
MIN_ANGLE = math.radians(1.5)  # rays that meet at a smaller angle do not tell depth
MAX_GAP_PX = 1.5  # rays that miss each other by more, seen from the camera, are not of one resting point
MIN_TRACKED_POINTS, MIN_TRACKED_SHARE = 40, 0.1
"""Least number of points that a score rests on, and their share of all that lie on tissue: a few beside a dark tube do
not speak for its depth."""
RELIEF_POINTS, MIN_RELIEF = 100, 0.03
"""Least number of points that tell the relief, and the median by which the logarithm of their depth must differ."""
FEW_POINTS = "too few points could be followed on tissue"
STANDS = "the camera stands still"


def compute(context: EvaluationContext) -> None:
    """Compare rendered frames of the split, carried points and depth with what the video says."""
    with context.skip_if_unavailable("gain_over_flow", "gain_over_mean"):
        _image_references(context)
    with context.skip_if_unavailable("slip_px", "depth_triangulated_error", "depth_relief"):
        _point_references(context, context.scene)


def _image_references(context: EvaluationContext) -> None:
    training, rows = context.sequence.frames("train"), []
    if not len(training):
        raise ScoreUnavailable("there is no training frame")
    average = mean_image(training)
    with frame_threads(BYTES_PER_PX * average.size) as pool:
        moves = pool.map(lambda frame: moved_frame(training, frame), context.frames)
        for frame, (moved, known) in zip(context.frames, moves, strict=True):
            image, true, mask = context.rendered[frame.index].rgb, frame.rgb, frame.tissue_mask
            here = psnr_tissue(image, true, mask & known), psnr_tissue(moved, true, mask & known)
            everywhere = psnr_tissue(image, true, mask), psnr_tissue(average, true, mask)
            gains = (ours - other for ours, other in (here, everywhere))
            rows.append(dict(zip(("gain_over_flow", "gain_over_mean"), gains, strict=True)))
    context.add_frames(rows, "no tissue in the split")


def mean_image(frames: FrameList) -> NDArray[np.float32]:
    """(H, W, 3) mean color in [0, 1] of up to `MEAN_FRAMES` frames over their tissue; of all pixels where none is."""
    chosen = [frames[k] for k in evenly_spaced(len(frames), MEAN_FRAMES)]
    weight, tissue, every = np.zeros_like(chosen[0].rgb[..., :1]), *np.zeros((2, *chosen[0].rgb.shape), np.float32)
    for frame in chosen:
        mask = frame.tissue_mask[..., None]
        weight += mask
        tissue += frame.rgb * mask
        every += frame.rgb
    return np.where(weight > 0, tissue / np.maximum(weight, 1), every / np.float32(len(chosen)))


def moved_frame(training: FrameList, frame: Frame) -> tuple[NDArray[np.float32], Mask]:
    """The nearest training frame, moved to a frame by the flow between both: (H, W, 3) color; (H, W) True where it is
    tissue. Pixels that it does not show come from the nearest one on the other side.
    """
    height, width = frame.tissue_mask.shape
    if min(height, width) < MIN_SIZE_PX:
        raise ScoreUnavailable(f"frames are smaller than {MIN_SIZE_PX} px, the least for optical flow")
    order = sorted(range(len(training)), key=lambda k: abs(training.indices[k] - frame.index))[:2]
    color, known = np.zeros_like(frame.rgb), np.zeros_like(frame.tissue_mask)
    shrink = fine_shrink(height, width)
    now = gray_for_flow(frame.rgb_u8, shrink)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    for k in order:
        other = training[k]
        flow = cv2.resize(fine_flow(now, gray_for_flow(other.rgb_u8, shrink)), (width, height))
        scale = np.float32(width / now.shape[1]), np.float32(height / now.shape[0])
        at = x + flow[..., 0] * scale[0], y + flow[..., 1] * scale[1]
        tissue = cv2.remap(other.tissue_mask.astype(np.float32), *at, cv2.INTER_LINEAR) > 0.999
        new = tissue & ~known
        color[new] = cv2.remap(other.rgb, *at, cv2.INTER_LINEAR)[new]
        known |= tissue
    return color, known


def _point_references(context: EvaluationContext, scene: Scene) -> None:
    sequence = context.sequence
    ahead = min(AHEAD, len(sequence) - 1)
    slips, errors, reliefs, tried = list[NDArray](), list[NDArray](), list[NDArray](), 0
    starts = evenly_spaced(len(sequence) - ahead, STARTS)
    with frame_threads(BYTES_PER_PX * sequence.frame(0).tissue_mask.size) as pool:
        paths = list(pool.map(lambda k: follow(sequence, k, ahead), starts))
    for k, followed in zip(starts, paths, strict=True):
        tried += followed.tried
        if not len(followed.start):
            continue
        camera, time = sequence.camera(k), k / len(sequence)
        surface = render_surface(scene, time, camera)
        depth = depth_at(surface, followed.start)
        good = np.isfinite(depth) & (depth > 0)
        start, end, depth = followed.start[good], followed.end[good], depth[good]
        last = sequence.camera(k + ahead)
        points = back_project(start, depth, camera)
        carried = carry_points(scene, points, np.zeros(len(points), np.intp), [time, (k + ahead) / len(sequence)])[1]
        pixels, seen = project_visible(carried, render_surface(scene, (k + ahead) / len(sequence), last))
        gap = np.linalg.norm(pixels - end, axis=1) * REFERENCE_WIDTH_PX / last.width
        slips.append(gap[seen])
        true, told = triangulated(start, end, camera, last)
        errors.append(np.abs(true[told] / depth[told] - 1))
        if told.any():
            logs = np.log([true[told], depth[told]])
            reliefs.append(logs - np.median(logs, 1, keepdims=True))
    for name, values, why in (
        ("slip_px", slips, FEW_POINTS),
        ("depth_triangulated_error", errors, f"{STANDS}, or {FEW_POINTS}"),
    ):
        found = np.concatenate(values) if values else np.zeros(0)
        enough = len(found) >= max(MIN_TRACKED_POINTS, MIN_TRACKED_SHARE * tried)
        context.add(name, float(np.median(found)) if enough else math.nan, why)
    relief = relief_agreement(np.concatenate(reliefs, 1) if reliefs else np.zeros((2, 0)), MIN_TRACKED_SHARE * tried)
    context.add("depth_relief", relief, f"{STANDS}, the tissue is flat, or {FEW_POINTS}")


def relief_agreement(relief: NDArray[np.floating], least: float = 0) -> float:
    """Correlation of true and rendered relief (2, P), of `least` points or more; NaN where the true one is not seen."""
    relief = relief[:, np.abs(relief[0]) < 1]  # beyond, rays met by chance
    if relief.shape[1] < max(RELIEF_POINTS, least) or np.median(np.abs(relief[0])) < MIN_RELIEF:
        return math.nan
    true, told = relief - relief.mean(1, keepdims=True)
    return float((true * told).sum() / max(float(np.sqrt((true**2).sum() * (told**2).sum())), 1e-12))


@dataclass(frozen=True)
class Followed:
    """Points on tissue that flow follows from one frame to a later one and back."""

    start: NDArray[np.float32]  # (P, 2) px
    end: NDArray[np.float32]  # (P, 2) px
    tried: int  # number of points on tissue that were to be followed


def follow(sequence: FrameSequence, first: int, ahead: int) -> Followed:
    """Points of a grid on the tissue of a frame, followed from frame to frame for `ahead` frames.

    Points that stay while the image as a whole moves are of the border or of fibers. The images say so, not the poses,
    which are judged by these points.
    """
    frame = sequence.frame(first)
    height, width = frame.tissue_mask.shape
    step = width / GRID
    at = np.stack(np.meshgrid(np.arange(step / 2, width, step), np.arange(step / 2, height, step)), -1).reshape(-1, 2)
    now = start = (at - HALF).astype(np.float32)
    gray = gray_for_flow(frame.rgb_u8, 1)
    kept = shown_pixels(now + HALF, frame.tissue_mask)
    tried = int(kept.sum())
    for index in range(first + 1, first + ahead + 1):
        before, frame = frame, sequence.frame(index)
        following = gray_for_flow(frame.rgb_u8, 1)
        there, returned = track_points(gray, following, now)
        step = align(gray, following, before.tissue_mask, frame.tissue_mask)
        if step is not None:
            returned &= ~fixed_in_image(there - now, now @ step[:2, :2].T + step[:2, 2] - now, width)
        kept &= returned & shown_pixels(there + HALF, frame.tissue_mask)
        gray, now = following, there
    return Followed(start[kept] + HALF, now[kept] + HALF, tried)


def triangulated(
    start: NDArray[np.floating], end: NDArray[np.floating], first: Camera, last: Camera
) -> tuple[NDArray[np.float64], Mask]:
    """(P,) z in the first camera, mm, of points seen at `start` by it and at `end` by the last one, (P, 2) px: the
    middle of where the two rays come nearest; and (P,) True where they meet, at an angle that tells the depth.
    """
    one = np.ones(len(start))
    origins = first.center, last.center
    rays = [back_project(pixels, one, camera) - camera.center for pixels, camera in ((start, first), (end, last))]
    a, b = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    cosine, between = (a * b).sum(1), origins[1] - origins[0]
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along = ((a @ between) - cosine * (b @ between)) / sine2
    back = (cosine * (a @ between) - (b @ between)) / sine2
    on_first, on_last = origins[0] + along[:, None] * a, origins[1] + back[:, None] * b
    pixels, z = project((on_first + on_last) / 2, first)
    meet = (along > 0) & (back > 0) & (z > 0) & (np.linalg.norm(pixels - start, axis=1) < MAX_GAP_PX)
    return z, meet & (np.arccos(np.clip(cosine, -1, 1)) > MIN_ANGLE)
