"""STIR clips (Surgical Tattoos in Infrared): points tattooed on tissue, visible in infrared before and after a clip.

A clip is a video without depth, so `endoprior prepare` comes first; `write_stir_tracks` then adds its points. STIR does
not pair the points of the end with those of the start: its benchmark compares each predicted end point with the nearest
true one. We do not pair them by distance either, because that would favor static scenes.
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from ..core.config import DataConfig
from ..core.shell import command
from ..core.types import Frame
from ..system.atomic import whole_file
from .description import RECORD, read_record
from .endonerf import load_endonerf
from .formats import DatasetFormat
from .images import decode_image, single_channel
from .reading import kind_of
from .sequence import FrameSequence
from .truth import Tracks

DEPTH_WINDOW_PX = 2  # depth of a point is the median of the measured depth up to so many pixels to each side
SEGMENTATIONS = ("segmentation/icgstartseg.png", "segmentation/icgendseg.png")
ASPECT_TOLERANCE = 0.01
"""Largest relative difference between the scales of width and height that rounding explains; a crop exceeds it."""


def is_stir(path: Path) -> bool:
    """Whether a folder is a STIR clip (`left/seqNN`), or contains one."""
    return (path / SEGMENTATIONS[0]).exists() or any(path.glob(f"left*/seq*/{SEGMENTATIONS[0]}"))


def load_stir(path: Path, _cfg: DataConfig) -> FrameSequence:
    """Explain how to prepare a clip, by stereo if the right camera and the calibration are there."""
    clips = [path] if (path / SEGMENTATIONS[0]).exists() else sorted(path.glob("left*/seq*"))
    clip = clips[0] if clips else path
    recording = Path(os.path.abspath(clip)).parents[1]
    right = recording / clip.parent.name.replace("left", "right", 1) / clip.name
    calibration = recording / "calib.json"
    options: list[str | Path] = ["--border", "keep", "--stir", clip]
    note = ""
    if right.is_dir() and calibration.is_file():
        options = ["--right", _video(right), "--calibration", calibration, *options]
    else:
        note = f"; without {calibration if right.is_dir() else right} its depth has no unit"
    hint = f"`{command('prepare', _video(clip), 'OUT', *options)}`{note} (docs/datasets.md)."
    raise input_error(path, "a prepared sequence", "a STIR clip, which has no depth", hint)


def _video(clip: Path) -> Path:
    """The video of one camera of a clip."""
    videos = sorted((clip / "frames").glob("*.mp4"))
    return videos[0] if videos else clip / "frames" / "VIDEO.mp4"


def tattoo_centers(path: Path) -> NDArray[np.float64]:
    """(P, 2) x, y of the marked spots of a segmentation image, px; the top-left pixel is centered at (0.5, 0.5).

    As in STIR's benchmark, they are the middles of the bounding boxes of connected regions that are not 0.
    """
    marked = (single_channel(path, decode_image(path, None)) > 0).astype(np.uint8)
    boxes = np.asarray(cv2.connectedComponentsWithStats(marked, None, None, None, 8)[2], np.float64)
    boxes = boxes[1:]  # the first is the background
    return boxes[:, :2] + boxes[:, 2:4] / 2


def stir_tracks(
    start_px: NDArray[np.float64], end_px: NDArray[np.float64], start: Frame, end: Frame, num_frames: int
) -> Tracks:
    """Unpaired material points: those of the start are visible in the first frame only, those of the end in the last.

    `start_px`, (P, 2) x, y, and `end_px`, (Q, 2), are in px of these frames. Spots without depth are left out; points
    are 0 where they are not visible.
    """
    first, last = _lift(start_px, start), _lift(end_px, end)
    points = np.zeros((num_frames, len(first) + len(last), 3), np.float32)
    visible = np.zeros(points.shape[:2], bool)
    points[0, : len(first)], points[-1, len(first) :] = first, last
    visible[0, : len(first)], visible[-1, len(first) :] = True, True
    return Tracks(points, visible)


def _lift(spots: NDArray[np.float64], frame: Frame) -> NDArray[np.float64]:
    """(P', 3) points in camera axes, mm, of the (P, 2) spots that have measured depth around them."""
    camera, points = frame.camera, []
    for x, y in spots:
        rows, columns = (slice(max(0, int(v) - DEPTH_WINDOW_PX), int(v) + DEPTH_WINDOW_PX + 1) for v in (y, x))
        measured = frame.depth[rows, columns][frame.depth_valid[rows, columns]]
        if measured.size:
            z = float(np.median(measured))
            points.append(((x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z))
    return np.array(points).reshape(-1, 3)


def nearest_end_errors(predicted: NDArray[np.floating], true_ends: NDArray[np.floating]) -> NDArray[np.float64]:
    """(P,) distance of predicted end points (P, K) to the nearest true one (Q, K): the error of STIR's benchmark."""
    return np.linalg.norm(predicted[:, None] - true_ends[None], axis=-1).min(1)


def demand_stir_clip(clip: Path) -> None:
    """Raise InputError unless a folder is a `left/seqNN` of STIR; called before long work."""
    for name in SEGMENTATIONS:
        if kind_of(clip / name) != "a file":
            raise input_error(clip / name, "a clip of STIR", "no such file", "pass its folder left/seqNN.")


def write_stir_tracks(clip: Path, prepared: Path) -> Path:
    """Write `truth/tracks.npz` of a prepared clip from its segmentations; returns the file.

    Spots are those of the raw image. They go to the frame as its pixels did: through the rectification and the crop
    that `prepare.json` records. The file also has `paired`, False: STIR does not pair starts with ends.

    Args:
        clip: STIR's `left/seqNN` folder.
        prepared: the folder that `endoprior prepare` wrote for its video, all frames.
    """
    clip, prepared = Path(clip), Path(prepared)
    sequence = load_endonerf(prepared, DataConfig(lift_missing_depth=False))
    record = read_record(prepared)
    if record is None:
        fix = "prepare the clip again, with --stir."
        raise input_error(prepared / RECORD, "the record of `prepare`, to rectify spots", "no such file", fix)
    start, end = sequence.frame(0), sequence.frame(len(sequence) - 1)
    spots = []
    for name, frame in zip(SEGMENTATIONS, (start, end), strict=True):
        height, width = decode_image(clip / name, None).shape[:2]
        scale = np.array(record.source_size) / (width, height)
        if abs(scale[0] / scale[1] - 1) > ASPECT_TOLERANCE:
            want = f"the shape of the video, {record.source_size[0]}x{record.source_size[1]} px"
            raise input_error(clip / name, want, f"{width}x{height}", "pass the clip whose video was prepared.")
        shares = record.in_frame(tattoo_centers(clip / name) * scale)
        spots.append(shares[np.isfinite(shares).all(1)] * (frame.camera.width, frame.camera.height))
    tracks = stir_tracks(spots[0], spots[1], start, end, len(sequence))
    for name, visible, found in zip(SEGMENTATIONS, tracks.visible[[0, -1]], spots, strict=True):
        if not visible.any():
            got = f"none of {len(found)}"
            raise input_error(clip / name, "spots where the frame has depth", got, "use another clip.")
    target = prepared / "truth" / "tracks.npz"
    target.parent.mkdir(exist_ok=True)
    with whole_file(target) as part:
        np.savez_compressed(part, points=tracks.points, visible=tracks.visible, paired=False)
    return target


FORMAT = DatasetFormat(is_stir, load_stir)
