"""How the images of two cameras are stored in one video frame: detect the layout, split the frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .calibration import Calibration

Layout = Literal["auto", "mono", "side-by-side", "top-bottom", "interlaced", "two-files"]
LOOK_ALIKE = 0.8
"""Correlation above which the halves of a frame are two views of the same scene."""
CONTENT = 3.0
"""Least standard deviation, levels of 255, of a frame that shows something, in each of its rows and columns."""


def split_cameras(frame: NDArray[np.uint8], layout: Layout) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Images of the first and second camera; the second is None for `mono` and `two-files`.

    Args:
        frame: (H, W, 3).
        layout: not `auto`. An interlaced frame holds the cameras in its even and odd rows. Both images come back with H
            rows, missing rows interpolated, so that rows keep their true heights.
    """
    height, width = frame.shape[:2]
    if layout == "side-by-side":
        return frame[:, : width // 2], frame[:, width // 2 : width // 2 * 2]
    if layout == "top-bottom":
        return frame[: height // 2], frame[height // 2 : height // 2 * 2]
    if layout == "interlaced":
        return _fill_rows(frame, 0), _fill_rows(frame, 1)
    return frame, None


def _fill_rows(frame: NDArray[np.uint8], parity: int) -> NDArray[np.uint8]:
    """(H, W, 3) with the rows of the other parity replaced by the mean of their neighbors."""
    filled = frame.copy()
    own = frame[parity::2].astype(np.uint16)
    between = ((own[:-1] + own[1:] + 1) // 2).astype(np.uint8)
    filled[parity + 1 : parity + 1 + 2 * len(between) : 2] = between
    if parity:
        filled[0] = frame[1]
    if (len(frame) - 1) % 2 != parity:
        filled[-1] = filled[-2]
    return filled


def camera_size(width: int, height: int, layout: Layout) -> tuple[int, int]:
    """(width, height) of one camera's image, px."""
    if layout == "side-by-side":
        return width // 2, height
    return (width, height // 2) if layout == "top-bottom" else (width, height)


def find_layout(
    frames: Sequence[NDArray[np.uint8]], calibration: Calibration | None, has_second_source: bool, name: str
) -> Layout:
    """Detect the layout from the image size of the calibration and from the content of a few frames.

    Args:
        frames: (H, W, 3) each, from all parts of the source. Black, uniform and striped ones say nothing; of the
            others, more than half must have the layout.
        name: of the source, for the error message.
    Raises:
        InputError: the layout cannot be detected.
    """
    if has_second_source:
        return "two-files"
    height, width = frames[0].shape[:2]
    telling = [frame for frame in frames if _shows_something(frame)]
    stereo = calibration is not None and calibration.right is not None
    kinds: tuple[Layout, ...] = ("side-by-side", "top-bottom", "interlaced")
    alike = [kind for kind in kinds if sum(_alike(frame, kind) for frame in telling) > len(telling) / 2]
    if not stereo:
        if alike and alike[0] != "interlaced":
            hint = f"`--calibration FILE --layout {alike[0]}`, or `--layout mono` if there is one camera."
            raise input_error(name, "a calibration for a stereo video", f"none, and a {alike[0]} frame", hint)
        return "mono"
    stated = calibration.layout or ""
    for kind in ("side-by-side", "top-bottom", "interlaced"):
        if kind in stated.lower():
            return kind
    if calibration.size:
        across, down = width / calibration.size[0], height / calibration.size[1]
        if abs(across / down - 2) < 0.02:
            return "side-by-side"
        if abs(across / down - 0.5) < 0.005:
            return "top-bottom"
        if abs(across / down - 1) < 0.01 and "interlaced" in alike:
            return "interlaced"
    if alike:
        return alike[0]
    hint = "`--layout side-by-side`, `top-bottom` or `interlaced`, or `--right VIDEO` for a second video."
    raise input_error(name, "two cameras in each frame", f"{width}x{height} px without a known layout", hint)


def _shows_something(frame: NDArray[np.uint8]) -> bool:
    """Whether a frame varies within its rows and within its columns, unlike a black one or color bars."""
    small = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), (96, 64), interpolation=cv2.INTER_AREA)
    small = small.astype(np.float32)
    return bool(min(np.median(small.std(0)), np.median(small.std(1))) > CONTENT)


def _alike(frame: NDArray[np.uint8], layout: Layout) -> bool:
    """Whether both halves show nearly the same image, up to a shift along x."""
    gray = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    if layout == "interlaced":
        rows = gray[: len(gray) // 2 * 2].astype(np.float32)
        # Rows of one camera are more similar to each other than to the rows of the other camera.
        own, other = np.abs(rows[2:] - rows[:-2]).mean(), np.abs(rows[1:] - rows[:-1]).mean()
        return bool(other > 1.2 * own)
    first, second = split_cameras(gray[..., None], layout)
    first, second = (
        cv2.resize(np.ascontiguousarray(camera), (96, 64), interpolation=cv2.INTER_AREA) for camera in (first, second)
    )
    middle = first[:, 16:-16].astype(np.float32)
    scores = cv2.matchTemplate(second.astype(np.float32), middle, cv2.TM_CCOEFF_NORMED)
    return bool(scores.max() > LOOK_ALIKE)
