"""Problems of a sequence, each with its fix. Pure functions: facts in, findings out.

The codes are stable; docs/check.md explains each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..core.checks import number_ranges
from ..core.shell import command
from ..footage.camera_motion import MOVING_FRACTION
from .facts import Facts

Severity = Literal["error", "warning", "note"]

TOOL_MOST = 0.6
"""With a larger share of tool pixels there is too little tissue for training."""
COVERED = 0.5
"""Depth on a smaller share of the tissue is sparse."""
FEW_FRAMES = 10
"""Fewer frames contain little motion and leave one test frame."""
SEEN_AS_TISSUE = 0.5
"""A border is reported if the masks mark a larger share of it as tissue."""
VERTICAL_PX = 1.5
"""Largest vertical offset of rectified cameras, px."""
ODD_VIEW_DEG = (20.0, 120.0)
"""Range of the horizontal field of view of endoscopes."""
DEPTH_JUMP = 0.2
"""Change of the log median depth between two frames that is too large for tissue motion."""


@dataclass(frozen=True)
class Finding:
    """One problem of a sequence."""

    code: str
    """Stable name."""
    severity: Severity
    """`error`: training would fail or learn something wrong; `warning`: it costs quality; `note`: good to know."""
    what: str
    """The problem, on one line."""
    fix: str
    """The command to type, or what to do."""
    frames: tuple[int, ...] = ()
    """Affected frames; empty for all."""

    def __str__(self) -> str:
        return f"{self.severity}: {self.code}: {self.what}. Fix: {self.fix}"


def find(facts: Facts) -> list[Finding]:
    """All findings, errors first."""
    found = [finding for check in CHECKS for finding in check(facts)]
    order = {"error": 0, "warning": 1, "note": 2}
    return sorted(found, key=lambda finding: order[finding.severity])


def _size(facts: Facts) -> Iterator[Finding]:
    if facts.frames < FEW_FRAMES:
        what = f"{facts.frames} frames, {facts.test_frames} of them to test"
        yield Finding("few-frames", "warning", what, f"give at least {FEW_FRAMES}; 50 to 200 are usual")
    camera = facts.camera
    view = 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))
    off_center = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    if not ODD_VIEW_DEG[0] <= view <= ODD_VIEW_DEG[1] or off_center > 0.2 or not 0.8 < camera.fx / camera.fy < 1.25:
        what = (
            f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g} px give {view:.0f} degrees across "
            f"{camera.width}x{camera.height} px; they may belong to images of another size"
        )
        yield Finding("intrinsics", "warning", what, f'set "fx", "fy", "cx", "cy" in {facts.path}/sequence.json, px')


def _masks(facts: Facts) -> Iterator[Finding]:
    masks, mean = facts.masks, float(facts.masks.tool_fraction.mean())
    if masks.inverted:
        what = f"tissue and tool are swapped in the masks ({masks.reason})"
        value = 0 if facts.described.get("mask_tool_value", 255) == 255 else 255
        fix = f'set "mask_tool_value": {value} in {facts.path}/sequence.json'
        yield Finding("mask-polarity", "error", what, fix)
    elif mean > TOOL_MOST:
        what = f"{mean:.0%} of all pixels are tool"
        yield Finding("tool-fraction", "warning", what, "check the masks; 5 % to 40 % are usual")
    elif not masks.tool_fraction.any():
        what = "no mask marks a tool"
        yield Finding("tool-fraction", "note", what, "nothing if no instrument is in view, else add masks")


def _depth(facts: Facts) -> Iterator[Finding]:
    depth, path, unit = facts.depth, facts.path, facts.depth.unit
    # With inverted masks, depth on tissue cannot be checked.
    empty = tuple(int(i) for i in np.flatnonzero(depth.coverage == 0))
    if len(empty) == facts.frames and unit.unit == "none":
        yield Finding(
            "no-depth-frames", "error", "no frame has depth", f"endoprior prepare CLIP NEW, or add {path}/depth in mm"
        )
        return
    if empty and not facts.masks.inverted:
        what = f"no depth on tissue in {_frames(empty)}"
        yield Finding("no-depth-frames", "warning", what, f"measure it, or remove these frames from {path}", empty)
    covered = float(np.median(depth.coverage))
    if 0 < covered < COVERED and not facts.masks.inverted:
        what = f"depth on {covered:.0%} of the tissue of a usual frame"
        yield Finding(
            "depth-sparse", "warning", what, "measure it again with a denser method, endoprior prepare --help"
        )
    if depth.bits == 8:
        known = f" {unit.unit}" if unit.mm_per_unit else ""
        what = f"8 bits a value, steps of {depth.step:.3g}{known}"
        fix = (
            f'write {path}/depth as 16-bit PNG in units of 0.01 mm and set "depth_scale": 0.01 in {path}/sequence.json'
        )
        yield Finding("depth-8-bit", "warning", what, fix)
    if depth.relative:
        fix = "nothing for rendering; for lengths in mm use stereo depth"
        yield Finding("relative-depth", "note", "the scale of the depth is unknown or assumed", fix)
    yield from _unit(facts)
    steps = np.abs(np.diff(np.log(np.where(depth.median > 0, depth.median, np.nan))))
    usual = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
    jumps = tuple(int(i) + 1 for i in np.flatnonzero(steps > max(DEPTH_JUMP, 6 * usual)))
    if jumps:
        what = f"the median depth jumps at {_frames(jumps)}"
        yield Finding("depth-jumps", "warning", what, "bring the depth of all frames to one scale", jumps)


def _unit(facts: Facts) -> Iterator[Finding]:
    unit = facts.depth.unit
    if unit.unit == "disparity":
        fix = "store depth in mm: focal length (px) x baseline (mm) / disparity (px)"
        yield Finding("depth-disparity", "error", unit.reason, fix)
    elif facts.depth.relative or unit.unit in ("mm", "none"):
        return
    elif unit.mm_per_unit is None:
        fix = f"{_set_scale(facts, None)}, so that the tissue is some 20 to 250 mm away"
        yield Finding("depth-unit", "error", unit.reason, fix)
    else:
        code = {"m": "depth-metres", "cm": "depth-centimetres"}.get(unit.unit, "depth-unit")
        what = f"depth looks like {unit.unit}, not mm ({unit.reason})"
        yield Finding(code, "error", what, _set_scale(facts, unit.mm_per_unit))


def _set_scale(facts: Facts, factor: float | None) -> str:
    """The command that multiplies depth by `factor`; None if the factor is unknown."""
    scale = "MM_PER_UNIT" if factor is None else f"{facts.depth.scale * factor:.6g}"
    return (
        f'set "depth_scale": {scale} in {facts.path}/sequence.json, '
        f"or {command('train', facts.path, 'RUN', '--data.depth-unit-mm', scale)}"
    )


def _border(facts: Facts) -> Iterator[Finding]:
    border, camera = facts.border, facts.camera
    strips = border.strips
    if border.strips_as_tissue > SEEN_AS_TISSUE and strips:
        sides = " and ".join(f"{size} px at the {name}" for name, size in vars(strips).items() if size)
        what = f"a bar or console strip of {sides} counts as tissue"
        width = camera.width - strips.left - strips.right
        height = camera.height - strips.top - strips.bottom
        fix = f"endoprior prepare CLIP NEW --crop {strips.left},{strips.top},{width},{height}, or mark it in the masks"
        yield Finding("console-strip", "warning", what, fix)
    if border.circle and border.outside_as_tissue > SEEN_AS_TISSUE:
        what = f"the image is round (radius {border.circle.radius:.0f} px) and its outside counts as tissue"
        yield Finding("round-border", "warning", what, "mark the outside in the masks; endoprior prepare does")
    if border.overlays:
        boxes = ", ".join(f"{width}x{height} px at {x}, {y}" for x, y, width, height in border.overlays[:3])
        what = f"burned-in text counts as tissue: {boxes}{' and more' if len(border.overlays) > 3 else ''}"
        yield Finding("burned-in-text", "warning", what, "mark it in the masks; endoprior prepare does")


def _motion(facts: Facts) -> Iterator[Finding]:
    if not (facts.motion.moving and facts.camera_is_fixed):
        return
    beyond = np.flatnonzero(facts.motion.path_px > MOVING_FRACTION * facts.camera.width)
    first = int(beyond[0]) * facts.motion_step if len(beyond) else 0
    what = f"the camera moves, but it is static in the stored poses ({facts.motion.reason})"
    enough = first >= max(FEW_FRAMES, facts.frames / 2)
    fix = "endoprior prepare CLIP NEW --poses estimate"
    yield Finding("camera-moves", "warning", what, f"{fix}, or {_until(facts, first)}" if enough else fix)


def _changes(facts: Facts) -> Iterator[Finding]:
    changes, path = facts.changes, facts.path
    if copies := changes.duplicates:
        what = f"{len(copies)} of {facts.frames} frames repeat the one before: {_frames(copies)}"
        originals = sorted(set(range(facts.frames)) - set(copies))
        stride = originals[1] if len(originals) > 1 else 0
        regular = stride > 1 and originals == list(range(0, facts.frames, stride))
        fix = command("train", path, "RUN", "--data.stride", str(stride)) if regular else f"remove them from {path}"
        yield Finding("duplicate-frames", "warning", what, fix, copies)
    for code, frames, what in (
        ("exposure-jump", changes.exposure_jumps, "the brightness of the whole image jumps at"),
        ("scene-cut", changes.cuts, "the view changes abruptly at"),
    ):
        if frames:
            severity: Severity = "error" if code == "scene-cut" else "warning"
            yield Finding(code, severity, f"{what} {_frames(frames)}", _until(facts, frames[0]), frames)
    odd = tuple(sorted({*changes.blurred, *changes.off_color}))
    if odd:
        what = f"blurred, covered or outside the body: {_frames(odd)}"
        yield Finding("unexplained-frames", "warning", what, f"remove them from {path}", odd)


def _stereo(facts: Facts) -> Iterator[Finding]:
    stereo, path = facts.stereo, facts.path
    if stereo is None:
        return
    if stereo.order.swapped:
        fix = f"swap the folders {path}/images and {path}/right, and measure depth again"
        yield Finding("swapped-eyes", "error", f"left and right images are swapped ({stereo.reason})", fix)
    if stereo.vertical_px > VERTICAL_PX:
        what = f"the rows of left and right images are {stereo.vertical_px:.1f} px apart"
        yield Finding("vertical-offset", "warning", what, "rectify: endoprior prepare CLIP NEW --calibration FILE")


def _points(facts: Facts) -> Iterator[Finding]:
    explained = facts.depth.unit.unit in ("none", "m", "0.01 mm") or facts.masks.inverted
    if facts.cloud is None and not explained:
        what = "no pixel is tissue and has depth, so training has no initial points"
        yield Finding("no-points", "error", what, "check masks and depth in the figure")


def _reader_notes(facts: Facts) -> Iterator[Finding]:
    for note in facts.notes:
        yield Finding("reader", "note", note, "check the files")


CHECKS: tuple[Callable[[Facts], Iterator[Finding]], ...] = (
    _masks,
    _depth,
    _border,
    _stereo,
    _motion,
    _changes,
    _size,
    _points,
    _reader_notes,
)
"""In the order of the report."""


def _frames(frames: tuple[int, ...]) -> str:
    """Frame numbers as text, at most six ranges: `frames 3-7, 9`."""
    return f"frame{'s' if len(frames) > 1 else ''} {number_ranges(frames, 6)}"


def _until(facts: Facts, first: int) -> str:
    """The command that leaves out the frames from `first` on, or those before it, whichever are fewer."""
    if first >= facts.frames / 2:
        return command("train", facts.path, "RUN", "--data.first-frames", str(first))
    return f"remove frames 0-{first - 1} from {facts.path}"
