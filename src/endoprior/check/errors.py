"""Errors of a sequence, each with its fix: training would learn something wrong. All are cheap to look for.

They need a few frames, and small copies of the others: about 2 % of the time of a training, which says them, too.
"""

from __future__ import annotations

from collections.abc import Iterator

from ..core.config import DataConfig
from ..data import FrameSequence
from ..footage.changes import find_cuts
from ..footage.depth_unit import UnitGuess
from ..footage.mask_polarity import Polarity
from ..footage.pose_fit import PoseFit
from ..footage.stereo_order import StereoOrder
from ..system.parallel import frame_threads
from .finding import About, Finding, convert_poses, frame_list, longest_part, set_values
from .samples import (
    about_sequence,
    are_inverted,
    as_read,
    measure_polarity,
    measure_pose_fit,
    measure_unit,
    order_of_eyes,
    sample_frames,
    true_tissue,
)

BYTES_PER_PX = 100  # memory in which a thread measures a frame, bytes for each px


def find_errors(sequence: FrameSequence) -> list[Finding]:
    """What `check` calls an error and a training would not notice. What ends a training says so by itself."""
    about, camera = about_sequence(sequence, sequence.reading or DataConfig()), sequence.camera(0)
    video = sequence.frames("video")
    with frame_threads(BYTES_PER_PX * camera.width * camera.height) as pool:
        cuts = find_cuts((frame.rgb_u8 for frame in video), pool.map)
        samples = sample_frames(sequence)
        polarity = measure_polarity(samples)
        unit = measure_unit(samples, true_tissue(samples, polarity))
        fit, order = measure_pose_fit(sequence, pool.map), order_of_eyes(sequence)
    return [
        *swapped_masks(about, polarity),
        *wrong_unit(about, unit, is_guess=sequence.depth_is_guessed),
        *(wrong_poses(about, fit) if fit else ()),
        *scene_cuts(about, cuts),
        *(swapped_eyes(about, order) if order else ()),
    ]


def swapped_masks(about: About, polarity: Polarity) -> Iterator[Finding]:
    """Tissue is read as tool."""
    if are_inverted(polarity):
        what = f"tissue and tool are swapped in the masks ({as_read(polarity)})"
        value = 0 if about.described.get("mask_tool_value", 255) == 255 else 255
        yield Finding("mask-polarity", "error", what, set_values(about, mask_tool_value=value))


def wrong_unit(about: About, unit: UnitGuess, *, is_guess: bool) -> Iterator[Finding]:
    """Depth is not in mm. Args: is_guess: its scale is unknown, or was found in another way: any distance is right."""
    if unit.unit == "disparity":
        fix = "store depth in mm: focal length (px) x baseline (mm) / disparity (px)"
        fix += ", or run `prepare` with `--depth-relative disparity` for relative depth"
        yield Finding("depth-disparity", "error", unit.reason, fix)
    elif is_guess or unit.unit in ("mm", "none"):
        return
    elif unit.mm_per_unit is None:
        fix = f"{set_values(about, depth_scale='MM_PER_UNIT')}, so that the tissue is some 20 to 250 mm away"
        yield Finding("depth-unit", "error", unit.reason, fix)
    else:
        code = {"m": "depth-metres", "cm": "depth-centimetres"}.get(unit.unit, "depth-unit")
        what = f"depth looks like {unit.unit}, not mm ({unit.reason})"
        scale = f"{about.depth_scale * unit.mm_per_unit:.6g}"
        fix = f"{set_values(about, depth_scale=scale)}, or train with `--data.depth-unit-mm {scale}`"
        yield Finding(code, "error", what, fix)


def wrong_poses(about: About, fit: PoseFit) -> Iterator[Finding]:
    """Camera poses have another convention."""
    if fit.another_fits:
        what = f"the camera poses explain the images better in another convention: depth reprojects to {fit.reason}"
        yield Finding("poses-convention", "error", what, convert_poses(about, fit.best, fit.unit))


def scene_cuts(about: About, cuts: tuple[int, ...]) -> Iterator[Finding]:
    """The clip shows several views. Args: cuts: the first frames of all but the first."""
    if cuts:
        what = f"the view changes abruptly at {frame_list(cuts)}"
        yield Finding("scene-cut", "error", what, longest_part(about, cuts), cuts)


def swapped_eyes(about: About, order: StereoOrder) -> Iterator[Finding]:
    """The left images are those of the right camera."""
    if order.swapped:
        fix = "run `prepare` with `--swap-eyes`, or without it where it was given; "
        fix += f"by hand: swap the folders {about.path}/images and {about.path}/right, and measure depth again"
        yield Finding("swapped-eyes", "error", f"left and right images are swapped ({order.reason})", fix)
