"""For images of which size was a camera calibrated? A wrong answer scales every length, and shows nowhere.

A file that states no size is used as it is only if its principal point is that of the video. Otherwise the user is
asked. Sizes are (width, height) of one camera's image, px.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from .calibration import Calibration, Intrinsics

CENTERED = 0.1
"""Mean principal points of endoscopes are off the image center by less than this share of half the image ..."""
FAR_OFF = 0.5
"""... and if it is further off than this, the images were cropped or have another size."""
SAME_ASPECT = 0.01
SQUEEZED = 0.12
"""A factor from 2 that counts as 2, as a share: an image at half its width or height."""
USUAL_RATIOS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4)
NEAR_RATIO = 0.06
"""An estimated ratio this near to a usual one is that one, as a share."""

Size = tuple[int, int]


def parse_size(text: str) -> Size:
    """`1280x1024`; raises InputError for another form."""
    if found := re.fullmatch(r"([1-9][0-9]{0,5})[x,]([1-9][0-9]{0,5})", text.strip()):
        return int(found[1]), int(found[2])
    raise input_error("--calibration-size", "WIDTHxHEIGHT in px", repr(text), "`--calibration-size 1280x1024`.")


def written_in_order(size: Size, cameras: Sequence[Intrinsics]) -> Size:
    """A stated pair as (width, height): NumPy's shapes are (height, width), and the principal point tells."""
    as_stated, turned = (
        np.abs(np.log(_ratios(cameras, pair))).sum() if _in_front(cameras) else 0.0 for pair in (size, size[::-1])
    )
    return size[::-1] if turned < as_stated / 2 else size


def fitted(calibration: Calibration, size: Size, name: str, *, squeezed: bool) -> tuple[Calibration, list[str]]:
    """The calibration in px of images of this size, and notes on what was decided.

    Args:
        size: of one camera's image, stretched if it was squeezed.
        name: of the calibration file, for messages.
        squeezed: whether the user says that images are squeezed.
    Raises:
        InputError: its images had another shape, or the size of its images is unknown and not clear.
    """
    cameras = [camera for camera in (calibration.left, calibration.right) if camera]
    if calibration.size is None:
        across, down = _ratios(cameras, size)
        if max(abs(across - 1), abs(down - 1)) > CENTERED:
            raise _unknown_size(calibration, (across, down), size, name)
        note = (
            f"{name} states no image size; {size[0]}x{size[1]} px are taken, because its principal point fits. If its "
            f"images had another size: --calibration-size WIDTHxHEIGHT"
        )
        return replace(calibration, size=size), [note]
    across, down = size[0] / calibration.size[0], size[1] / calibration.size[1]
    if abs(across / down - 1) > SAME_ASPECT:
        raise _other_shape(calibration.size, across / down, size, name, squeezed)
    off = np.abs(_ratios(cameras, calibration.size) - 1)
    if off.max() > FAR_OFF and not calibration.size_is_sure:
        x, y = calibration.left.matrix[:2, 2] - 0.5
        hint = "Correct the size in the file, or state it: `--calibration-size WIDTHxHEIGHT`."
        want = f"a principal point near the center of its {calibration.size[0]}x{calibration.size[1]} px"
        raise input_error(name, want, f"({x:g}, {y:g})", hint)
    if calibration.size == size:
        return calibration, []
    grow = np.diag([across, down, 1.0])
    scaled = [
        camera and replace(camera, matrix=grow @ camera.matrix) for camera in (calibration.left, calibration.right)
    ]
    note = f"the calibration is scaled from {calibration.size[0]}x{calibration.size[1]} to {size[0]}x{size[1]} px"
    return replace(calibration, left=scaled[0], right=scaled[1], size=size), [note]


def _ratios(cameras: Sequence[Intrinsics], size: Size) -> NDArray[np.float64]:
    """(2,) twice the mean principal point, in image widths and heights: 1 at the center."""
    return 2 * np.mean([camera.matrix[:2, 2] for camera in cameras], 0) / size


def _in_front(cameras: Sequence[Intrinsics]) -> bool:
    return bool(cameras) and all((camera.matrix[:2, 2] > 0).all() for camera in cameras)


def _unknown_size(calibration: Calibration, ratios: tuple[float, float], size: Size, name: str) -> InputError:
    """The error that asks for the size, with the likely answer."""
    (across, down), (x, y) = ratios, calibration.left.matrix[:2, 2] - 0.5
    if min(across, down) > 0 and abs(across / down - 1) < CENTERED:
        ratio = (across + down) / 2
        usual = min(USUAL_RATIOS, key=lambda each: abs(np.log(each / ratio)))
        ratio = usual if abs(usual / ratio - 1) < NEAR_RATIO else ratio
        fix = f"`--calibration-size {round(size[0] * ratio)}x{round(size[1] * ratio)}` if its images had that size."
    elif min(across, down) > 0 and _is_squeezed(across / down):
        fix = "`--squeezed-eyes` if both cameras share a frame at half their width or height."
    else:
        fix = "`--calibration-size WIDTHxHEIGHT` with the size of its images; if they were cropped, crop the same part."
    want = f"the size of its images, or a principal point near the center of {size[0]}x{size[1]} px"
    return input_error(name, want, f"no size, and ({x:g}, {y:g})", fix)


def _other_shape(stated: Size, aspect: float, size: Size, name: str, squeezed: bool) -> InputError:
    fix = "Pass the calibration of this video, or set --layout."
    if not squeezed and _is_squeezed(1 / aspect):
        fix = "`--squeezed-eyes` if both cameras share a frame at half their width or height; else set --layout."
    elif squeezed and _is_squeezed(aspect):
        fix = "Remove --squeezed-eyes."
    want = f"images of {stated[0]}x{stated[1]} px, or the same aspect ratio"
    return input_error(name, want, f"{size[0]}x{size[1]}", fix)


def _is_squeezed(aspect: float) -> bool:
    """Whether one axis has twice the scale of the other."""
    return abs(aspect / 2 - 1) < SQUEEZED or abs(aspect * 2 - 1) < SQUEEZED
