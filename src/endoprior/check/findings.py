"""Problems of a sequence, each with its fix. Pure functions: facts in, findings out.

`find` looks for all of them. `find_errors`, for trainings, measures only what the worst ones need: a few frames, and
small copies of the others, in about 2 % of the time of a training. The codes are stable; docs/check.md explains each.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..core.checks import frame_list, quotation
from ..core.config import DataConfig
from ..core.geometry import length_unit
from ..core.shell import command
from ..data import FrameSequence
from ..data.description import MOTION, SIZE_NOT_STATED
from ..data.image_folders import ways_to_prepare
from ..data.mask_files import Polarity
from ..footage.camera_motion import MOVING_FRACTION
from ..footage.changes import find_cuts
from ..footage.depth_unit import FAR_MM, UnitGuess
from ..footage.disturbances import DARK_MEAN_GRAY
from ..footage.pose_fit import PoseFit
from ..footage.stereo_matching import StereoOrder
from ..model.presets import preset
from ..system.parallel import frame_threads
from .facts import (
    BYTES_PER_PX,
    Facts,
    are_inverted,
    as_read,
    measure_polarity,
    measure_pose_fit,
    measure_unit,
    order_of_cameras,
    sample_frames,
)
from .finding import About, Finding, about_sequence, convert_poses, longest_part, set_values, skip

TOOL_MOST = 0.6  # With a larger share of tool pixels there is too little tissue for training
COVERED = 0.5  # Depth on a smaller share of the tissue is sparse
FEW_FRAMES = 10  # Fewer contain little motion and leave one test frame
SEEN_AS_TISSUE = 0.5  # A border is reported if the masks mark a larger share of it as tissue
VERTICAL_PX = 1.5  # Largest vertical offset of rectified cameras, px
ODD_VIEW_DEG = (20.0, 120.0)  # Range of the horizontal field of view of endoscopes
OFF_SCALE, SAME_SCALE = 0.2, 0.1
"""A principal point off by more than the first, and on both axes alike up to the second: another size."""
USUAL_FOCAL = 0.9  # Focal length of a usual endoscope, image widths: 58 degrees
ITERATION_S, USUAL_PIXELS, FIXED_SHARE = 0.09, 640 * 512, 0.3
"""Seconds of a training iteration with `default` on two cores, start included, at this size of the image, and the share
that does not depend on it (docs/results.md)."""
EXPORT = "export them again, with all values from 0 to 255 in use"
WHITE = 0.99  # A larger share of the tissue that is overexposed leaves nothing to train on
FAR_SHARE = 1e-3
"""A larger share of the tissue beyond the reach of an endoscope is a filling of holes, or a wrong depth."""
DEPTH_JUMP = 0.2  # Change of the log median depth between two frames that is too large for tissue motion


def find(facts: Facts) -> list[Finding]:
    """All findings, errors first."""
    checks = (_masks, _depth, _border, _stereo, _motion, _poses, _windows, _changes, _video, _intrinsics, _rest)
    order = ("error", "warning", "note")
    return sorted((found for check in checks for found in check(facts)), key=lambda found: order.index(found.severity))


def find_errors(sequence: FrameSequence) -> list[Finding]:
    """The errors that a training would not notice, and learn something wrong. What ends it says so by itself."""
    about, camera = about_sequence(sequence, sequence.reading or DataConfig()), sequence.camera(0)
    video = sequence.frames("video")
    with frame_threads(BYTES_PER_PX * camera.width * camera.height) as pool:
        cuts = find_cuts((frame.rgb_u8 for frame in video), pool.map)
        samples = sample_frames(sequence)
        polarity = measure_polarity(samples)
        unit = measure_unit(samples, polarity)
        fit, order = measure_pose_fit(sequence, pool.map), order_of_cameras(sequence)
    return [
        *_swapped_masks(about, polarity),
        *_wrong_unit(about, unit, is_guess=sequence.depth_is_guessed),
        *(_wrong_poses(about, fit) if fit else ()),
        *_scene_cuts(about, cuts),
        *(_swapped_cameras(about, order) if order else ()),
    ]


def _intrinsics(facts: Facts) -> Iterator[Finding]:
    camera = facts.camera
    if facts.sources.get("lens") == SIZE_NOT_STATED:
        what = (
            "the calibration does not state the size of its images, and its principal point fits "
            f"{camera.width}x{camera.height} px; if they had another size, every length is wrong"
        )
        fix = "nothing if that is so; else run `prepare` with `--calibration-size WIDTHxHEIGHT`"
        yield Finding("calibration-size", "note", what, fix)
    center = np.array([camera.cx / camera.width, camera.cy / camera.height])
    scale = 2 * float(center.mean())
    # Both halves of the center off by one factor: numbers for images of another size. A crop moves them apart.
    other_size = abs(scale - 1) > OFF_SCALE and abs(center[0] - center[1]) < SAME_SCALE * center.mean()
    odd = not ODD_VIEW_DEG[0] <= facts.view_deg <= ODD_VIEW_DEG[1] or not 0.8 < camera.fx / camera.fy < 1.25
    if not (odd or other_size or np.abs(center - 0.5).max() > 0.2):
        return
    what = (
        f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g} px give {facts.view_deg:.0f} degrees "
        f"across {camera.width}x{camera.height} px; they may belong to images of another size"
    )
    if other_size:
        yield Finding("intrinsics", "warning", what, _rescale_camera(facts, scale))
        return
    width, height = camera.width * facts.data.shrink, camera.height * facts.data.shrink
    usual = {"fx": USUAL_FOCAL * width, "fy": USUAL_FOCAL * width, "cx": width / 2, "cy": height / 2}
    fix = set_values(facts, **{name: f"{value:g}" for name, value in usual.items()})
    fix += f", which is usual for endoscopes, or what the calibration says for {width}x{height} px"
    if facts.sources.get("depth", "").startswith("stereo"):
        fix += ", and measure depth again: it comes from the same numbers"
    yield Finding("intrinsics", "warning", what, fix)


def _masks(facts: Facts) -> Iterator[Finding]:
    masks, mean = facts.masks, float(facts.masks.tool_fraction.mean())
    if unsure := masks.uncertain:
        what = f"the program that found the tools is unsure in {frame_list(unsure)}"
        fix = f"look at them and correct them: `{command('view', facts.path)}`"
        yield Finding("uncertain-masks", "warning", what, fix, unsure)
    yield from _swapped_masks(facts, masks.polarity)
    if masks.inverted:
        return
    if mean > TOOL_MOST:
        what = f"{mean:.0%} of the pixels inside the border are tool"
        again = "" if "tools found" in facts.sources.get("masks", "") else ", or find tools by `endoprior masks`"
        yield Finding("tool-fraction", "warning", what, f"correct the masks, 5 % to 40 % are usual{again}")
    elif not masks.tool_fraction.any():
        only = ": the masks cover only the border" if facts.border.masked.any() else ""
        what = f"no tools were found{only}; if tools are in view, they become tissue"
        yield Finding("tool-fraction", "warning", what, f"nothing if no tool is in view; else {_add_tools(facts)}")
    if like := masks.tissue_like:
        what = f"what is masked at x {like.x}, y {like.y} of frame {like.frame} moves with the tissue in every frame"
        free = command("masks", facts.path, "--tissue", f"{like.frame},{like.x},{like.y}")
        fix = f"nothing if it is a tool; else `{free}`"
        yield Finding("masked-tissue", "warning", what, fix, (like.frame,))


def _depth(facts: Facts) -> Iterator[Finding]:
    depth, path, unit = facts.depth, facts.path, facts.depth.unit
    again = _measure_again(facts)
    or_again = f", or {again}" if again else ""
    # With inverted masks, depth on tissue cannot be checked.
    empty = tuple(int(i) for i in np.flatnonzero(depth.coverage == 0))
    if len(empty) == facts.frames and unit.unit == "none":
        fix = ways_to_prepare(path) if facts.needs_depth else again or f"add {path}/depth in mm"
        yield Finding("no-depth-frames", "error", "no frame has depth", fix)
        return
    if empty and not facts.masks.inverted:
        what = f"no depth on tissue in {frame_list(empty)}"
        fix = again if again and len(empty) > facts.frames / 2 else skip(facts, empty)
        yield Finding("no-depth-frames", "warning", what, fix, empty)
    covered = float(np.median(depth.coverage))
    if 0 < covered < COVERED and not facts.masks.inverted:
        what = f"depth on {covered:.0%} of the tissue of a usual frame"
        yield Finding("depth-sparse", "warning", what, again or "measure it by a denser method")
    if depth.bits == 8:
        known = f" {length_unit(True) if depth.relative else unit.unit}" if unit.mm_per_unit else ""
        what = f"8 bits a value, steps of {depth.step:.3g}{known}"
        yield Finding("depth-8-bit", "warning", what, f"export {path}/depth as 16-bit PNG{or_again}")
    if depth.relative:
        known = command("scale", facts.path, "--known-length", "FRAME,X1,Y1,X2,Y2,MM")
        fix = f"nothing for rendering; for lengths in mm `{known}`"
        yield Finding("relative-depth", "note", "the scale of the depth is unknown or assumed", fix)
    beyond = tuple(int(i) for i in np.flatnonzero(depth.far > FAR_SHARE))
    if beyond and unit.unit == "mm" and not depth.relative:
        share = float(depth.far[list(beyond)].mean())
        what = f"depth beyond {FAR_MM:g} mm on {share:.1%} of the tissue with depth in {frame_list(beyond)}"
        fix = f"store 0 where depth is missing, in {path}/depth{or_again}"
        yield Finding("depth-far", "warning", what, fix, beyond)
    steps = np.abs(np.diff(np.log(np.where(depth.median > 0, depth.median, np.nan))))
    usual = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
    jumps = tuple(int(i) + 1 for i in np.flatnonzero(steps > max(DEPTH_JUMP, 6 * usual)))
    if jumps:
        what = f"the median depth jumps at {frame_list(jumps)}"
        fix = f"bring the depth of all frames to one scale{or_again}"
        yield Finding("depth-jumps", "warning", what, fix, jumps)
    yield from _wrong_unit(facts, unit, is_guess=depth.relative or depth.known is not None)


def _border(facts: Facts) -> Iterator[Finding]:
    border = facts.border
    in_masks = "mark it in the masks" if facts.takes_masks else "nothing can mask it: this layout has no masks"
    if border.strips_as_tissue > SEEN_AS_TISSUE and border.strips:
        sides = " and ".join(f"{size} px at the {name}" for name, size in vars(border.strips).items() if size)
        what = f"a bar or console strip of {sides} counts as tissue"
        fix = f"run `prepare` with `--crop X,Y,WIDTH,HEIGHT`, without it, or {in_masks}"
        yield Finding("console-strip", "warning", what, fix)
    if border.outside_as_tissue > SEEN_AS_TISSUE:
        shape = f"is round (radius {border.circle.radius:.0f} px)" if border.circle else "has a border"
        what = f"the image {shape} and its outside counts as tissue"
        yield Finding("round-border", "warning", what, f"run `prepare` with `--border auto`, or {in_masks}")
    if border.overlays:
        boxes = ", ".join(f"{width}x{height} px at {x}, {y}" for x, y, width, height in border.overlays[:3])
        what = f"burned-in text counts as tissue: {boxes}{' and more' if len(border.overlays) > 3 else ''}"
        fix = f"run `prepare` with `--blank X,Y,WIDTH,HEIGHT`, or {in_masks}"
        yield Finding("burned-in-text", "warning", what, fix)


def _motion(facts: Facts) -> Iterator[Finding]:
    is_unknown = facts.sources.get(MOTION) == "unknown"  # as `prepare` says, which has tried to find a path
    if facts.camera_is_fixed and (is_unknown or facts.motion.kind == "unknown"):
        how = "how the camera moves is unknown" if facts.motion.moving else "whether the camera moves is unknown"
        what = f"{how}, and it is static in the stored poses ({facts.motion.reason})"
        yield Finding(
            "camera-unknown", "warning", what, "look at the video; use more frames per second, or a shorter part"
        )
    if is_unknown or not (facts.motion.moving and facts.camera_is_fixed):
        return
    beyond = np.flatnonzero(facts.motion.path_px > MOVING_FRACTION * facts.camera.width)
    first = int(beyond[0]) * facts.motion_step if len(beyond) else 0
    what = f"the camera moves, but it is static in the stored poses ({facts.motion.reason})"
    enough = first >= max(FEW_FRAMES, facts.frames / 2)
    still = f", or train with `--data.first-frames {first}`" if enough else ""
    yield Finding("camera-moves", "warning", what, f"run `prepare` with `--poses estimate`{still}")


def _poses(facts: Facts) -> Iterator[Finding]:
    fit = facts.pose_fit
    if fit is None:
        return
    yield from _wrong_poses(facts, fit)
    if fit.none_fits:
        what = f"the camera poses do not explain the images in any convention: depth reprojects to {fit.reason}"
        fix = f"match each pose to its frame, or `{command('poses', facts.path, '--poses', 'estimate')}`"
        yield Finding("poses-convention", "warning", what, fix)


def _windows(facts: Facts) -> Iterator[Finding]:
    if len(facts.windows) == 1:
        return
    lengths = [stop - start for start, stop in facts.windows]
    spans = f"{min(lengths)} to {max(lengths)}" if min(lengths) < max(lengths) else f"{lengths[0]}"
    iterations = len(lengths) * preset("default").schedule.fine_iterations
    share = FIXED_SHARE + (1 - FIXED_SHARE) * facts.camera.width * facts.camera.height / USUAL_PIXELS
    minutes = iterations * ITERATION_S * share / 60
    why = "a long video" if facts.camera_is_fixed else "the camera moves far"
    what = (
        f"{why}: it is trained in {len(lengths)} windows of {spans} frames, in about {minutes:.0f} min on two cores, "
        "with the memory of one window"
    )
    fix = "nothing; `--ray ADDRESS` trains windows on several machines, and `--windows.longest` changes their length"
    yield Finding("windows", "note", what, fix)


def _changes(facts: Facts) -> Iterator[Finding]:
    changes = facts.changes
    if copies := changes.duplicates:
        what = f"{len(copies)} of {facts.frames} frames repeat the one before: {frame_list(copies)}"
        originals = sorted(set(range(facts.frames)) - set(copies))
        stride = originals[1] if len(originals) > 1 else 0
        regular = stride > 1 and originals == list(range(0, facts.frames, stride))
        regular = regular and facts.data in (DataConfig(), DataConfig(shrink=facts.data.shrink))
        fix = f"train with `--data.stride {stride}`" if regular else skip(facts, copies)
        yield Finding("duplicate-frames", "warning", what, fix, copies)
    if jumps := changes.exposure_jumps:
        what = f"the brightness of the whole image jumps at {frame_list(jumps)}"
        yield Finding("exposure-jump", "warning", what, longest_part(facts, jumps), jumps)
    yield from _scene_cuts(facts, changes.cuts)
    # Frames that `prepare` marked count from the first one of the folder.
    whole = facts.data == DataConfig(shrink=facts.data.shrink)
    marked = facts.described.get("unexplained_frames", []) if whole else []
    odd = tuple(sorted({*changes.blurred, *changes.off_color, *marked}))
    if odd:
        reasons = "blurred, covered or outside the body" + (", damaged, or without a camera pose" if marked else "")
        what = f"{reasons}: {frame_list(odd)}"
        fix = skip(facts, odd)
        if len(marked) == facts.frames:
            what += "; these are all, so that training uses them as if each had a pose"
            fix = "use another part of the video, or more frames per second"
        elif marked and facts.data.reliability == "used":
            what += f"; neither trained on nor scored are {frame_list(tuple(marked))}"
        yield Finding("unexplained-frames", "warning", what, fix, odd)


def _video(facts: Facts) -> Iterator[Finding]:
    """What `prepare` found particular about the video, and images that are nearly black, or white in part."""
    brightness = float(np.median(facts.changes.brightness))
    if brightness < DARK_MEAN_GRAY:
        what = f"the images are nearly black: their mean is {255 * brightness:.0f} of 255"
        yield Finding("dark-images", "warning", what, EXPORT)
    if facts.overexposed.mean() > WHITE:
        what = "all tissue is overexposed: white, and without any detail"
        yield Finding("overexposed", "error", what, f"{EXPORT}; if the video is so, choose another part of it")
    elif len(white := np.flatnonzero(facts.overexposed)):
        share, frames = facts.overexposed[white].mean(), tuple(white.tolist())
        what = f"{share:.0%} of the tissue is overexposed, in {frame_list(frames)}: its color is a guess"
        fix = "nothing for this video: the color is lost; record with less light or exposure"
        yield Finding("overexposed", "warning", what, fix, frames)
    fix = "nothing if you expect this; else copy or export the video again"
    yield from (Finding("video", "note", quotation(n), fix) for n in (facts.record.video_notes if facts.record else ()))


def _stereo(facts: Facts) -> Iterator[Finding]:
    stereo = facts.stereo
    if stereo is None:
        return
    yield from _swapped_cameras(facts, stereo.order)
    if stereo.vertical_px > VERTICAL_PX:
        what = f"the rows of left and right images are {stereo.vertical_px:.1f} px apart"
        moved = facts.record and "--row-offset" in facts.record.options
        fix = "the calibration of this video" if moved else "`--row-offset auto`, or the calibration of this video"
        yield Finding("vertical-offset", "warning", what, f"run `prepare` with {fix}")


def _rest(facts: Facts) -> Iterator[Finding]:
    if facts.frames < FEW_FRAMES:
        what = f"{facts.frames} frames, {facts.test_frames} of them to test"
        yield Finding("few-frames", "warning", what, f"give at least {FEW_FRAMES}; 50 to 200 are usual")
    explained = facts.depth.unit.unit in ("none", "m", "0.01 mm") or facts.masks.inverted
    if facts.cloud is None and not explained:
        what = "no pixel is tissue and has depth, so training has no initial points"
        yield Finding("no-points", "error", what, "check masks and depth in the figure")
    wrong = "`prepare` makes what is missing" if facts.needs_depth else "correct the file that is named"
    for note in facts.notes:
        fix = "run that command" if "`endoprior " in note else f"nothing if that is so; else {wrong}"
        yield Finding("reader", "note", note, fix)


def _measure_again(facts: Facts) -> str:
    """Measure depth by another method than the present one; empty if there is none."""
    present = facts.sources.get("depth", "")
    if present == "shading":
        return ""
    return f"run `prepare` {'with `--depth shading`' if present.startswith('stereo') else 'without `--depth`'}"


def _add_tools(facts: Facts) -> str:
    """What adds tools to masks without any."""
    if not facts.takes_masks:
        return "leave out its frames with `--data.skip-frames`; this layout has no masks"
    by_hand = f"paint them: `{command('view', facts.path)}`, or run `prepare` with `--masks FOLDER`"
    if "tools found" in facts.sources.get("masks", ""):
        return by_hand
    return f"find them: `{command('masks', facts.path)}`, or {by_hand}"


def _rescale_camera(facts: Facts, factor: float) -> str:
    """Correct a camera for images `factor` times as large, and stereo depth, which comes from the same numbers."""
    camera, record = facts.camera, facts.record
    numbers = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    values = {name: f"{value * facts.data.shrink / factor:g}" for name, value in numbers.items()}
    if facts.sources.get("depth", "").startswith("stereo"):
        values["depth_scale"] = f"{facts.depth_scale / factor:.6g}"
    fix = f"{set_values(facts, **values)}, or what the calibration says for these images"
    if record and "--calibration" in record.options:
        size = "x".join(str(round(side * factor)) for side in record.source_size)
        fix += f"; or run `prepare` with `--calibration-size {size}`, if the calibration was made at this size"
    return fix


def _swapped_masks(about: About, polarity: Polarity) -> Iterator[Finding]:
    """Tissue is read as tool."""
    if are_inverted(polarity):
        what = f"tissue and tool are swapped in the masks ({as_read(polarity)})"
        value = 0 if about.described.get("mask_tool_value", 255) == 255 else 255
        yield Finding("mask-polarity", "error", what, set_values(about, mask_tool_value=value))


def _wrong_unit(about: About, unit: UnitGuess, *, is_guess: bool) -> Iterator[Finding]:
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


def _wrong_poses(about: About, fit: PoseFit) -> Iterator[Finding]:
    """Camera poses have another convention."""
    if fit.another_fits:
        what = f"the camera poses explain the images better in another convention: depth reprojects to {fit.reason}"
        yield Finding("poses-convention", "error", what, convert_poses(about, fit.best, fit.unit))


def _scene_cuts(about: About, cuts: tuple[int, ...]) -> Iterator[Finding]:
    """The clip shows several views. Args: cuts: the first frames of all but the first."""
    if cuts:
        what = f"the view changes abruptly at {frame_list(cuts)}"
        yield Finding("scene-cut", "error", what, longest_part(about, cuts), cuts)


def _swapped_cameras(about: About, order: StereoOrder) -> Iterator[Finding]:
    """The left images are those of the right camera."""
    if order.swapped:
        fix = "run `prepare` with `--swap-eyes`, or without it where it was given; "
        fix += f"by hand: swap the folders {about.path}/images and {about.path}/right, and measure depth again"
        yield Finding("swapped-eyes", "error", f"left and right images are swapped ({order.reason})", fix)
