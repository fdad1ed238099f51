"""What a few frames of a sequence tell, evenly spaced: polarity, unit, poses, the order of the cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.geometry import camera_to_world
from ..core.ranges import evenly_spaced
from ..core.types import Frame
from ..data import FrameSequence
from ..data.files import in_order
from ..data.images import read_color
from ..footage.components import Image, InOrder, Mask
from ..footage.depth_unit import UnitGuess, guess_unit
from ..footage.mask_polarity import Polarity, mask_polarity
from ..footage.pose_fit import PoseFit, RgbdFrame, measure_poses
from ..footage.stereo_matching import StereoOrder, stereo_order, vertical_offset_px

SAMPLES = 20  # frames for measurements that are expensive
CERTAIN = 0.5  # least certainty to report masks as inverted
COMPARED = 3  # stereo pairs to compare


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
        (sequence.frame(int(i)).rgb_u8, read_color(files[int(i)], (camera.width, camera.height)))
        for i in np.linspace(0, count - 1, COMPARED).round()
    ]


def _mean_order(pairs: list[tuple[Image, Image]]) -> StereoOrder | None:
    orders = [stereo_order(*pair) for pair in pairs]
    if not orders:
        return None
    return StereoOrder(*(float(np.mean([getattr(o, name) for o in orders])) for name in ("as_given", "exchanged")))
