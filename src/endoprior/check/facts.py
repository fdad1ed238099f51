"""What a sequence is, measured: sizes, time, cameras, borders, masks, depth, changes, eyes, first points.

Shared letters: `T` frames, `H, W` image size. Cheap curves cover every frame; dear measurements look at a few.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError
from ..core.config import DataConfig
from ..core.types import Camera, Frame
from ..data import FrameSequence
from ..data.description import read_description
from ..footage.border import Circle, Strips, find_circle, find_strips
from ..footage.camera_motion import CameraMotion, camera_motion
from ..footage.changes import Changes, find_changes
from ..footage.polarity import Polarity, mask_polarity
from ..footage.text import find_static_overlays
from ..initialization.sampling import initial_points
from .depth_facts import DepthFacts, measure_depth
from .eyes_facts import EyeFacts, measure_eyes

if TYPE_CHECKING:
    from ..initialization.cleanup import PointCloud

LOOKED_AT = 20
"""Frames, evenly spread, that dear measurements look at."""
FOLLOWED = 300
"""At most so many frames are followed for the motion of the camera."""
CERTAIN = 0.5
"""Certainty from which it is believed that masks are read inverted."""
LIFTED = 24
"""At most so many training frames give first points."""


@dataclass(frozen=True)
class MaskFacts:
    """Masks as they are read, tools being where tissue is not."""

    tool_fraction: NDArray[np.float64]
    """(T,) share of tool pixels."""
    polarity: Polarity
    """Judged of the masks as they are read: `tool_is_high` False says that tissue is where tools should be."""

    @property
    def inverted(self) -> bool:
        """Whether what is read as tissue is certainly the tool."""
        return not self.polarity.tool_is_high and self.polarity.certainty >= CERTAIN

    @property
    def reason(self) -> str:
        """The evidence in one line."""
        return self.polarity.reason.replace("high values cover", "what is read as tool covers")

    def tissue(self, frame: Frame) -> NDArray[np.bool_]:
        """(H, W) True on the tissue of a frame, masks that are read inverted put right."""
        return ~frame.tissue_mask if self.inverted else frame.tissue_mask


@dataclass(frozen=True)
class BorderFacts:
    """What surrounds the tissue, and how much of it is read as tissue."""

    strips: Strips
    """Still or black strips at the sides, px."""
    strips_as_tissue: float
    """Share of the strips' pixels that the masks call tissue; 0 without strips."""
    circle: Circle | None
    """Round border of the endoscope's picture."""
    outside_as_tissue: float
    """Share of the pixels outside the circle that the masks call tissue; 0 without one."""
    overlays: tuple[tuple[int, int, int, int], ...]
    """x, y, width, height of burned-in labels that the masks call tissue, px."""


@dataclass(frozen=True)
class Facts:
    """Everything that is known of a sequence."""

    path: Path
    frames: int
    """T."""
    train_frames: int
    test_frames: int
    frames_per_second: float | None
    camera: Camera
    """The first frame's."""
    described: dict[str, Any]
    """What `sequence.json` says; empty without one."""
    sources: dict[str, str]
    """Where each part came from, as far as the folder says."""
    remarks: tuple[str, ...]
    """What the reader found odd, one line each."""
    camera_path_mm: float
    """Largest distance of a stored camera from the first one."""
    camera_turn_deg: float
    """Largest rotation of a stored camera from the first one."""
    motion: CameraMotion
    """Motion of the picture as a whole."""
    motion_step: int
    """`motion` compares frames this far apart."""
    changes: Changes
    masks: MaskFacts
    border: BorderFacts
    depth: DepthFacts
    eyes: EyeFacts | None
    """None without a right eye's pictures."""
    cloud: PointCloud | None
    """First points, from at most 24 training frames; None where there are none."""

    @property
    def camera_is_fixed(self) -> bool:
        """Whether the stored poses say that the camera stands still."""
        return self.camera_path_mm < 1e-3 and self.camera_turn_deg < 1e-3


def measure(sequence: FrameSequence, cfg: DataConfig | None = None) -> Facts:
    """Measure a sequence; every frame is decoded and stays in the sequence's cache, as in training.

    Args:
        sequence: as training would read it.
        cfg: what it was opened with.
    Raises:
        InputError: a file cannot be used.
    """
    count = len(sequence)
    frames = sequence.frames("video")
    few = [sequence.frame(int(i)) for i in spread(count, LOOKED_AT)]
    pictures = [frame.rgb_u8 for frame in few]
    polarity = mask_polarity([~frame.tissue_mask for frame in few], pictures)
    masks = MaskFacts(np.array([1 - frame.tissue_mask.mean() for frame in frames]), polarity)
    step = -(-count // FOLLOWED)
    followed = [sequence.frame(i) for i in range(0, count, step)]
    distance, turn = _camera_path([sequence.camera(i) for i in range(count)])
    described = read_description(sequence.path / "sequence.json")
    return Facts(
        path=sequence.path,
        frames=count,
        train_frames=len(sequence.indices("train")),
        test_frames=len(sequence.indices("test")),
        frames_per_second=sequence.frames_per_second,
        camera=sequence.camera(0),
        described=described,
        sources=dict(sequence.sources),
        remarks=tuple(sequence.remarks),
        camera_path_mm=distance,
        camera_turn_deg=turn,
        motion=camera_motion([f.rgb_u8 for f in followed], [masks.tissue(f) for f in followed]),
        motion_step=step,
        changes=find_changes(frame.rgb_u8 for frame in frames),
        masks=masks,
        border=_border(pictures, [masks.tissue(frame) for frame in few]),
        depth=measure_depth(sequence, few, [masks.tissue(frame) for frame in few], described, cfg or DataConfig()),
        eyes=measure_eyes(sequence),
        cloud=_first_points(sequence),
    )


def spread(count: int, wanted: int) -> list[int]:
    """At most `wanted` positions of 0..count-1, evenly spread, both ends included."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, wanted)).round()})


def _camera_path(cameras: list[Camera]) -> tuple[float, float]:
    """Largest distance, mm, and largest rotation, degrees, of a camera from the first."""
    first = cameras[0]
    distance = max(float(np.linalg.norm(camera.center - first.center)) for camera in cameras)
    turns = [camera.world_to_camera[:3, :3] @ first.world_to_camera[:3, :3].T for camera in cameras]
    return distance, float(np.degrees(max(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) for turn in turns)))


def _border(pictures: list[NDArray[np.uint8]], tissue_masks: list[NDArray[np.bool_]]) -> BorderFacts:
    tissue = np.mean(tissue_masks, axis=0)
    height, width = tissue.shape
    strips, circle = find_strips(pictures), find_circle(pictures)
    in_strip = np.ones((height, width), bool)
    in_strip[strips.top : height - strips.bottom, strips.left : width - strips.right] = False
    outside = ~circle.mask(width, height) if circle else np.zeros((height, width), bool)
    return BorderFacts(
        strips,
        _mean(tissue[in_strip]),
        circle,
        _mean(tissue[outside]),
        tuple(box for box in find_static_overlays(pictures) if _is_label(box, tissue, in_strip | outside)),
    )


def _is_label(box: tuple[int, int, int, int], tissue: NDArray[np.floating], border: NDArray[np.bool_]) -> bool:
    """Whether a box of writing lies in the picture, not in its border, and the masks call most of it tissue."""
    x, y, width, height = box
    inside = slice(y, y + height), slice(x, x + width)
    return _mean(tissue[inside]) > 0.5 and _mean(border[inside]) < 0.5


def _mean(values: NDArray) -> float:
    return float(values.mean()) if values.size else 0.0


def _first_points(sequence: FrameSequence) -> PointCloud | None:
    train = sequence.frames("train")
    frames = [train[i] for i in spread(len(train), LIFTED)]
    if not any((frame.tissue_mask & frame.depth_valid).any() for frame in frames):
        return None
    try:
        return initial_points(frames)
    except InputError:  # too few tissue pixels with depth; the findings say why
        return None
