"""Measure a sequence: sizes, time, cameras, borders, masks, depth, changes, stereo pair, initial points.

Shared letters: `T` frames, `H, W` image size. Cheap measurements cover every frame, expensive ones a few samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError
from ..core.config import DataConfig
from ..core.geometry import camera_to_world
from ..core.ranges import evenly_spaced
from ..core.types import Camera, Frame
from ..data import FrameSequence
from ..data.files import in_order
from ..data.formats import needs_depth
from ..data.found_tools import UNCERTAIN, read_rows
from ..data.images import read_color
from ..data.mask_files import Polarity, mask_polarity
from ..data.pixels import measured_share, overexposed
from ..data.scale import Scale
from ..data.window_plan import plan_windows, summarize_frames
from ..footage.border import Outline, Strips, find_outline, masked_border
from ..footage.camera_motion import CameraMotion
from ..footage.changes import Changes
from ..footage.depth_unit import FAR_MM, UnitGuess, guess_unit
from ..footage.image_operations import Image, InOrder, Mask
from ..footage.known_facts import KnownFacts
from ..footage.overlays import without_strokes
from ..footage.pose_fit import PoseFit, RgbdFrame, measure_poses
from ..footage.round_border import Circle
from ..footage.stereo_matching import StereoOrder, stereo_order, vertical_offset_px
from ..footage.text_network import TextDetector
from ..footage.texts import static_rectangles
from ..initialization.sampling import initial_points
from ..model.presets import preset
from ..system.parallel import Pool, frame_threads
from .finding import About, about_sequence
from .masked_tissue import MaskedTissue, find_masked_tissue

if TYPE_CHECKING:
    from ..initialization.sampling import PointCloud

SAMPLES = 20  # frames for measurements that are expensive
CERTAIN = 0.5  # least certainty to report masks as inverted
COMPARED = 3  # stereo pairs to compare
BYTES_PER_PX = 100  # memory in which a thread measures a frame, bytes for each px
MOTION_FRAMES = 300  # largest number of frames for the camera motion
POINT_FRAMES = 24  # largest number of training frames for the initial points
LABEL_ON_TISSUE = 0.75  # least share of a text box that the masks mark as tissue
USUAL_RATE = 25.0  # frames/s of a sequence that does not say it
BINS = 80  # of the histogram of depth
EVERY = 7  # the distribution of depth uses every 7th pixel


@dataclass(frozen=True)
class MaskFacts:
    """Masks as read; every pixel that is neither tissue nor border is tool."""

    tool_fraction: NDArray[np.float64]  # (T,) share of tool pixels inside the masked border
    polarity: Polarity  # of the masks as read: `tool_is_high` False means that tissue and tool are swapped
    confidence: NDArray[np.float64]
    """(T,) how sure the program was that found them, 0..1; NaN where no program did, or a person corrected them."""
    tissue_like: MaskedTissue | None  # a masked region that moves with the tissue in nearly all frames

    @property
    def inverted(self) -> bool:
        """Whether tissue and tool are certainly swapped."""
        return are_inverted(self.polarity)

    @property
    def uncertain(self) -> tuple[int, ...]:
        """Frames whose masks should be looked at, ascending."""
        return tuple(int(i) for i in np.flatnonzero(self.confidence < UNCERTAIN))

    @property
    def reason(self) -> str:
        """The measurements in one line."""
        return as_read(self.polarity)

    def tissue(self, frame: Frame) -> Mask:
        """(H, W) True on the tissue of a frame; inverted masks are corrected."""
        return true_tissue(frame, self.polarity)


@dataclass(frozen=True)
class BorderFacts:
    """Borders around the endoscope image, and how much of them the masks mark as tissue."""

    strips: Strips  # static or black strips at the sides, px
    strips_as_tissue: float  # share of the strips' pixels that are marked as tissue; 0 without strips
    circle: Circle | None  # round border of the endoscope image
    outside: Mask  # (H, W) True beyond the round border, or one of any other shape
    outside_as_tissue: float  # share of these pixels that are marked as tissue; 0 without any
    sharpness: float  # share of the outline of a border that is no circle which is sharp; 1 without one
    overlays: tuple[tuple[int, int, int, int], ...]
    """x, y, width, height of burned-in labels that are marked as tissue, px."""
    masked: Mask
    """(H, W) True on the pixels that the masks exclude as border, not as tool: see `footage.border.masked_border`."""


@dataclass(frozen=True)
class DepthFacts:
    """Depth as read; in mm if the folder states the right unit. Statistics are of tissue, 0 without depth there."""

    coverage: NDArray[np.float64]  # (T,) share of tissue pixels with depth
    measured: float | None  # share of the tissue where it was measured, and is no guess; None where that is not known
    median: NDArray[np.float64]  # (T,) NaN in a frame without any
    far: NDArray[np.float64]  # (T,) share of the tissue pixels with depth that are farther than `FAR_MM`
    low: float  # 1st percentile
    high: float  # 99th percentile
    edges: NDArray[np.float64]  # (81,) of the histogram bins
    counts: NDArray[np.int64]  # (80,) sampled tissue pixels in each bin
    step: float  # median difference between neighboring values of a frame
    bits: int | None  # per stored value; None if unknown
    unit: UnitGuess
    relative: bool  # whether the folder states that its scale is unknown
    known: Scale | None = None  # how relative depth was brought to mm


@dataclass(frozen=True)
class StereoFacts:
    """Consistency of the left and right images."""

    order: StereoOrder  # share of the image that matches in either order, mean over the compared frames
    vertical_px: float  # median vertical offset of matching features, px, >= 0; NaN if there are too few matches

    @property
    def reason(self) -> str:
        """The measurements in one line."""
        rows = f"rows {self.vertical_px:.1f} px apart" if np.isfinite(self.vertical_px) else "too few matches"
        return f"{self.order.reason}; {rows}"


@dataclass(frozen=True)
class Facts(About):
    """All measurements of a sequence."""

    train_frames: int
    test_frames: int
    frames_per_second: float | None
    camera: Camera  # of the first frame
    takes_masks: bool  # whether masks that a person paints are read; some layouts have none
    notes: tuple[str, ...]  # of the reader, one line each
    needs_depth: bool  # whether the folder has images only, and perhaps masks
    camera_path_mm: float  # largest distance of a stored camera from the first one
    camera_turn_deg: float  # largest rotation of a stored camera from the first one
    motion: CameraMotion  # of the image as a whole
    motion_step: int  # distance between the frames compared by `motion`
    windows: tuple[tuple[int, int], ...]
    """First frame, and the frame after the last one, of each window that `train` would cut the sequence into."""
    pose_fit: PoseFit | None  # how well the stored poses explain the images; None for a static camera
    changes: Changes
    overexposed: NDArray[np.float64]  # (T,) share of the tissue that is; 0 for the usual highlights
    masks: MaskFacts
    border: BorderFacts
    depth: DepthFacts
    stereo: StereoFacts | None  # None without right images
    cloud: PointCloud | None  # initial points from at most 24 training frames; None if there are none

    @property
    def camera_is_fixed(self) -> bool:
        """Whether the camera is static in the stored poses."""
        return self.camera_path_mm < 1e-3 and self.camera_turn_deg < 1e-3

    @property
    def view_deg(self) -> float:
        """Angle across the width of the image, degrees."""
        return float(2 * np.degrees(np.arctan(self.camera.width / 2 / self.camera.fx)))


def measure(sequence: FrameSequence, cfg: DataConfig | None = None, known: KnownFacts | None = None) -> Facts:
    """Measure a sequence that was opened with these options. Every frame is decoded and cached, as in training.

    Args:
        known: facts of its frames that are known already.
    """
    cfg, known = cfg or DataConfig(), known or KnownFacts()
    first = sequence.camera(0)
    with frame_threads(BYTES_PER_PX * first.width * first.height) as pool:
        return _measured(sequence, cfg, known, pool)


def _measured(sequence: FrameSequence, cfg: DataConfig, known: KnownFacts, pool: Pool) -> Facts:
    count = len(sequence)
    frames = sequence.frames("video")
    samples = sample_frames(sequence)
    images = [frame.rgb_u8 for frame in samples]
    polarity = measure_polarity(samples)
    outline = find_outline(without_strokes(images))
    decoded = pool.map(frames.__getitem__, range(count))  # and kept as memory allows
    masked = masked_border(outline, images, (frame.tissue_mask for frame in decoded))
    view = max(int((~masked).sum()), 1)
    tool_fraction = np.array([1 - frame.tissue_mask.sum() / view for frame in frames])
    tissue_like = find_masked_tissue(
        count,
        sequence.frames_per_second or USUAL_RATE,
        lambda i: sequence.frame(i).rgb_u8,
        lambda i: ~sequence.frame(i).tissue_mask & ~masked,
        pool.map,
    )
    masks = MaskFacts(tool_fraction, polarity, _confidence(sequence), tissue_like)
    step = -(-count // MOTION_FRAMES)
    followed = [sequence.frame(i) for i in range(0, count, step)]
    cameras = [sequence.camera(i) for i in range(count)]
    distance, turn = _camera_path(cameras)
    return Facts(
        **vars(about_sequence(sequence, cfg)),
        train_frames=len(sequence.indices("train")),
        test_frames=len(sequence.indices("test")),
        frames_per_second=sequence.frames_per_second,
        camera=cameras[0],
        takes_masks=sequence.takes_masks,
        notes=tuple(sequence.remarks),
        needs_depth=needs_depth(sequence.path),
        camera_path_mm=distance,
        camera_turn_deg=turn,
        motion=known.camera_motion(
            lambda: (frame.rgb_u8 for frame in followed), lambda: map(masks.tissue, followed), pool.map
        ),
        motion_step=step,
        windows=tuple(plan_windows(cameras, summarize_frames(sequence), preset("default").windows.longest)),
        pose_fit=measure_pose_fit(sequence, pool.map),
        changes=known.find_changes(lambda: (frame.rgb_u8 for frame in frames), pool.map),
        overexposed=np.array([_overexposed_share(frame) for frame in frames]),
        masks=masks,
        border=_border(outline, images, [masks.tissue(frame) for frame in samples], masked),
        depth=_depth(sequence, samples, masks),
        stereo=measure_stereo(sequence),
        cloud=_first_points(sequence),
    )


def _overexposed_share(frame: Frame) -> float:
    saturated = overexposed(frame)
    return 0.0 if saturated is None else float(saturated.sum() / frame.tissue_mask.sum())


def _confidence(sequence: FrameSequence) -> NDArray[np.float64]:
    """(T,) confidence of each frame's mask; NaN where it is unknown.

    The rows count the frames of the folder; of those that are read, the number in the image's name tells which it is.
    """
    rows, names, count = read_rows(sequence.path), sequence.image_names, len(sequence)
    numbered = len(names) == count and all(name.isdecimal() for name in names)
    places = range(count) if len(rows) == count else [int(name) for name in names] if numbered else [-1] * count
    known = {row.frame: row.confidence for row in rows}
    return np.array([known.get(place, np.nan) for place in places], np.float64)


def _camera_path(cameras: list[Camera]) -> tuple[float, float]:
    """Largest distance, mm, and largest rotation, degrees, from the first camera."""
    first = cameras[0]
    distance = max(float(np.linalg.norm(camera.center - first.center)) for camera in cameras)
    turns = [camera.world_to_camera[:3, :3] @ first.world_to_camera[:3, :3].T for camera in cameras]
    return distance, float(np.degrees(max(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) for turn in turns)))


def _first_points(sequence: FrameSequence) -> PointCloud | None:
    train = sequence.frames("train")
    frames = [train[int(i)] for i in evenly_spaced(len(train), POINT_FRAMES)]
    if not any((frame.tissue_mask & frame.depth_valid).any() for frame in frames):
        return None
    try:
        return initial_points(frames)
    except InputError:  # too few tissue pixels with depth; a finding reports it
        return None


def _border(outline: Outline, images: list[NDArray[np.uint8]], tissue_masks: list[Mask], masked: Mask) -> BorderFacts:
    """How the masks of the samples, corrected if inverted, mark the outline and the labels."""
    tissue, border = np.mean(tissue_masks, axis=0), outline.in_strip | outline.outside

    def is_label(box: tuple[int, int, int, int]) -> bool:
        """Whether a text box lies inside the border, and the masks mark most of it as tissue."""
        x, y, width, height = box
        inside = slice(y, y + height), slice(x, x + width)
        return _mean(tissue[inside]) > LABEL_ON_TISSUE and _mean(border[inside]) < 0.5

    return BorderFacts(
        outline.strips,
        _mean(tissue[outline.in_strip]),
        outline.circle,
        outline.outside,
        _mean(tissue[outline.outside]),
        outline.other.sharpness,
        tuple(filter(is_label, static_rectangles(images[::2], TextDetector().find))),
        masked,
    )


def _mean(values: NDArray) -> float:
    return float(values.mean()) if values.size else 0.0


def _depth(sequence: FrameSequence, samples: list[Frame], masks: MaskFacts) -> DepthFacts:
    """Coverage and median of every frame, and the distribution over the tissue of the samples."""
    coverage, median, far = [], [], []
    for frame in sequence.frames("video"):
        on_tissue = frame.depth_valid & frame.tissue_mask
        coverage.append(float(on_tissue.sum() / max(frame.tissue_mask.sum(), 1)))
        values = frame.depth[on_tissue]
        median.append(float(np.median(values[::EVERY])) if len(values) else float("nan"))
        far.append(_mean(values > FAR_MM))
    values = np.concatenate([frame.depth[frame.depth_valid & masks.tissue(frame)][::EVERY] for frame in samples])
    low, high = (float(v) for v in np.percentile(values, (1, 99))) if len(values) else (0.0, 0.0)
    margin = 0.1 * (high - low) or 0.1 * high or 1.0
    counts, edges = np.histogram(values, BINS, (max(low - margin, 0), high + margin))
    steps = [np.diff(np.unique(frame.depth[frame.depth_valid])) for frame in samples]
    usual = [float(np.median(step)) for step in steps if len(step)]
    header = b""
    if png := min((sequence.path / "depth").glob("*.png"), default=None):
        header = png.read_bytes()[:26]
    return DepthFacts(
        np.array(coverage),
        measured_share(samples),
        np.array(median),
        np.array(far),
        low,
        high,
        edges,
        counts,
        step=float(np.median(usual)) if usual else 0.0,
        bits=header[24] if len(header) == 26 else None,
        unit=measure_unit(samples, masks.polarity),
        relative=sequence.depth_is_relative,
        known=sequence.scale,
    )


def sample_frames(sequence: FrameSequence) -> list[Frame]:
    """The frames of which masks and depth are measured."""
    return [sequence.frame(i) for i in evenly_spaced(len(sequence), SAMPLES)]


def measure_polarity(samples: list[Frame]) -> Polarity:
    """Of the masks as read: `tool_is_high` False means that tissue and tool are swapped."""
    return mask_polarity([~frame.tissue_mask for frame in samples], [frame.rgb_u8 for frame in samples])


def are_inverted(polarity: Polarity) -> bool:
    """Whether tissue and tool are certainly swapped in masks as read."""
    return not polarity.tool_is_high and polarity.certainty >= CERTAIN


def as_read(polarity: Polarity) -> str:
    """The measurements of masks as read, in one line."""
    return polarity.reason.replace("high values cover", "pixels read as tool cover")


def true_tissue(frame: Frame, polarity: Polarity) -> Mask:
    """(H, W) True on the tissue of a frame; inverted masks are corrected."""
    return ~frame.tissue_mask if are_inverted(polarity) else frame.tissue_mask


def measure_unit(samples: list[Frame], polarity: Polarity) -> UnitGuess:
    """The unit of depth as read, on the tissue of the samples, whose masks have this polarity."""
    return guess_unit((each.depth, each.depth_valid, each.rgb_u8, true_tissue(each, polarity)) for each in samples)


def measure_pose_fit(sequence: FrameSequence, each: InOrder) -> PoseFit | None:
    """Reproject depth between frames with the stored poses; None for a static camera or without enough corners."""
    first = sequence.camera(0)

    def view(index: int) -> RgbdFrame:
        frame = sequence.frame(index)
        return frame.rgb_u8, frame.tissue_mask, np.where(frame.depth_valid, frame.depth, np.float32(0))

    matrix = np.array([[first.fx, 0, first.cx - 0.5], [0, first.fy, first.cy - 0.5], [0, 0, 1]])
    poses = camera_to_world(sequence.camera(i) for i in range(len(sequence)))
    return measure_poses(view, matrix, poses, relative=sequence.depth_is_guessed, each=each)


def measure_stereo(sequence: FrameSequence) -> StereoFacts | None:
    """Compare both cameras in a few frames; None without usable right images."""
    pairs = _pairs(sequence)
    known = [offset for offset in (vertical_offset_px(*pair) for pair in pairs) if np.isfinite(offset)]
    order = _mean_order(pairs)
    return order and StereoFacts(order, float(np.median(known)) if known else float("nan"))


def order_of_cameras(sequence: FrameSequence) -> StereoOrder | None:
    """Which images are the left ones; None without usable right images."""
    return _mean_order(_pairs(sequence))


def _pairs(sequence: FrameSequence) -> list[tuple[Image, Image]]:
    """Left and right images of a few frames; empty unless the folder has a right PNG of that size for each frame."""
    files = in_order((sequence.path / "right").glob("*.png"))
    camera, count = sequence.camera(0), len(sequence)
    if len(files) != count or read_color(files[0]).shape[:2] != (camera.height, camera.width):
        return []  # shrunk, or only a part of the folder: the matching of images to frames is unknown
    return [
        (sequence.frame(i).rgb_u8, read_color(files[i], (camera.width, camera.height)))
        for i in evenly_spaced(count, COMPARED)
    ]


def _mean_order(pairs: list[tuple[Image, Image]]) -> StereoOrder | None:
    orders = [stereo_order(*pair) for pair in pairs]
    if not orders:
        return None
    return StereoOrder(*(float(np.mean([getattr(o, name) for o in orders])) for name in ("as_given", "exchanged")))
