"""How one video frame holds the images of two cameras: side by side, top-bottom or in alternate rows, or not at all."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import input_error
from .calibration import Calibration
from .config import Layout

KINDS: tuple[Layout, ...] = ("side-by-side", "top-bottom", "interlaced")  # how one frame can hold two images
LOOK_ALIKE, BY_CHANCE = 0.55, 0.3
"""Correlation of the details of both halves of a frame above which they are two views of one scene, and by how much it
exceeds that with one half upside down. Shading does not count: halves of a tube or of a round image are alike.
"""
HALF_SIZE, DETAIL_PX = (192, 128), 3.0  # (width, height) of compared halves, and the size of their details, px
BLOCK, OFF_ROWS, OFF_COLUMNS = (28, 24), 5, 40  # (width, height) of a block, px, and how far away its match can lie
MIN_DETAIL = 1.0  # standard deviation of a block that shows something, levels
NUM_SAMPLE_IMAGES = 9  # images that tell the stereo layout
CONTENT = 3.0  # least standard deviation, levels, of a frame that shows something, in each of its rows and columns
Image = NDArray[np.uint8]


def split_cameras(frame: Image, layout: Layout) -> tuple[Image, Image | None]:
    """Images of the first and second camera; the second is None for `mono` and `two-files`.

    Args:
        frame: (H, W, 3). An interlaced one holds the cameras in its even and odd rows. Both images come back with H
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


def _fill_rows(frame: Image, parity: int) -> Image:
    """(H, W, 3) with the rows of the other parity replaced by the mean of their neighbors."""
    filled, own = frame.copy(), frame[parity::2].astype(np.uint16)
    filled[parity + 1 : parity + 2 * len(own) - 1 : 2] = (own[:-1] + own[1:] + 1) // 2
    if parity:
        filled[0] = frame[1]
    if (len(frame) - 1) % 2 != parity:
        filled[-1] = filled[-2]
    return filled


def camera_size(width: int, height: int, layout: Layout) -> tuple[int, int]:
    """(width, height) of one camera's image, px."""
    return width // (1 + (layout == "side-by-side")), height // (1 + (layout == "top-bottom"))


def find_layout(frames: Sequence[Image], calibration: Calibration | None, has_second_source: bool, name: str) -> Layout:
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
    telling = [frame for frame in frames if _shows_something(frame)]
    alike: list[Layout] = [kind for kind in KINDS if sum(_alike(frame, kind) for frame in telling) > len(telling) / 2]
    if calibration is None or calibration.right is None:
        if alike and alike[0] != "interlaced":
            fix = f"`--calibration FILE --layout {alike[0]}`, or `--layout mono` if there is one camera."
            raise input_error(name, "a calibration for a stereo video", f"none, and a {alike[0]} frame", fix)
        return "mono"
    height, width = frames[0].shape[:2]
    stated: list[Layout] = [kind for kind in KINDS if kind in (calibration.layout or "").lower()]
    found: list[Layout] = [*stated, *_by_size(width, height, calibration, alike), *alike]
    if found:
        return found[0]
    fix = "`--layout side-by-side`, `top-bottom` or `interlaced`, or `--right VIDEO` for a second video."
    raise input_error(name, "two cameras in each frame", f"{width}x{height} px without a known layout", fix)


def _by_size(width: int, height: int, calibration: Calibration, alike: list[Layout]) -> list[Layout]:
    """The layout whose frame holds two images of the calibrated shape."""
    if not calibration.size:
        return []
    aspect = width / calibration.size[0] / (height / calibration.size[1])
    fits = abs(aspect - 2) < 0.02, abs(aspect - 0.5) < 0.005, abs(aspect - 1) < 0.01 and "interlaced" in alike
    return [kind for kind, fit in zip(KINDS, fits, strict=True) if fit]


def _shows_something(frame: Image) -> bool:
    """Whether a frame varies within its rows and within its columns, unlike a black one or color bars."""
    small = _small(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY))
    return bool(min(np.median(small.std(0)), np.median(small.std(1))) > CONTENT)


def _alike(frame: Image, layout: Layout) -> bool:
    """Whether both halves show nearly the same details, up to shifts along x."""
    gray = np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), np.uint8)
    if layout == "interlaced":
        rows = gray[: len(gray) // 2 * 2].astype(np.float32)
        # Rows of one camera are more similar to each other than to the rows of the other camera.
        own, other = np.abs(rows[2:] - rows[:-2]).mean(), np.abs(rows[1:] - rows[:-1]).mean()
        return bool(other > 1.2 * own)
    first, second = (_details(half) for half in split_cameras(gray[..., None], layout) if half is not None)
    correlation, chance = _correlation(first, second), _correlation(first, second[::-1])
    return correlation > LOOK_ALIKE and correlation - chance > BY_CHANCE


def _correlation(first: NDArray, second: NDArray) -> float:
    """Median over blocks of the first half of the correlation with the most similar place in the second; 0 for none."""
    (width, height), found = BLOCK, list[float]()
    for y in range(OFF_ROWS, HALF_SIZE[1] - height - OFF_ROWS + 1, height):
        for x in range(OFF_COLUMNS, HALF_SIZE[0] - width - OFF_COLUMNS + 1, width):
            block = first[y : y + height, x : x + width]
            if block.std() > MIN_DETAIL:
                near = second[y - OFF_ROWS :, x - OFF_COLUMNS :][: height + 2 * OFF_ROWS, : width + 2 * OFF_COLUMNS]
                found.append(float(cv2.matchTemplate(near, block, cv2.TM_CCOEFF_NORMED).max()))
    return float(np.median(found)) if found else 0.0


def _details(gray: NDArray) -> NDArray:
    """A gray half of a frame at `HALF_SIZE` without its shading."""
    half = cv2.resize(np.ascontiguousarray(gray), HALF_SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)
    return half - cv2.GaussianBlur(half, (0, 0), DETAIL_PX)


def _small(gray: NDArray) -> NDArray:
    return cv2.resize(np.ascontiguousarray(gray), (96, 64), interpolation=cv2.INTER_AREA).astype(np.float32)
