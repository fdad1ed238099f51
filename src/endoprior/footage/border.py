"""Where the endoscope image ends: strips at the sides, a circle, and borders of any other shape.

What lies outside is dark in nearly all samples of the clip, at the edge of the image, and begins sharply. The level
that separates it is the one at which the outline is sharpest. Endoscope images are convex: a dark part that cuts into
the image is tissue or a tool, unless it is long and flat, and sharp too. Of several images in a frame the largest is
taken. `K` samples (H, W, 3) of one clip, at different times.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .image_operations import (
    AREA,
    Image,
    Mask,
    components,
    dilated,
    disk,
    distance_inside,
    largest_channel,
    regions_where,
    smallest_channel,
    square,
)
from .round_border import Circle, Darkness, blurred, find_circle, find_darkness, reduced

IN_SAMPLES = 0.9  # The outside is dark in this share of the samples; glare reaches over a border now and then
MAX_LEVEL = 20  # Median level of what can be outside
LEVEL_STEP, MAX_SHARE = 1.25, 0.5  # Factor between levels that are tried; the last is this share of the usual level
REACH = 0.006  # Length within which a sharp outline becomes bright, in sides of the image ...
MIN_REACH_PX = 3
RATIO, MAX_OF = 2.5, 0.5  # ... by this factor at least, and to this share of the level further inside
MIN_PICTURE, MIN_OUTSIDE = 0.05, 0.001  # Shares of the frame: of the endoscope image, and of one part outside
SHARP, ALIKE = 0.6, 0.02  # Least sharp share of an outline, and by how much less is as good as the best
FLAT = 3.0  # A part outside that cuts into the image is so many times longer along its edge than deep
FADED, MAX_RIM = 0.8, 4  # The rim has less than this share of the level deeper inside; its largest width, in reaches
CERTAIN = 0.9  # Below this sharp share of its outline, a border is uncertain
MOVES = 0.002  # A border moves if it hides this share of the frame in half of the samples
MIN_EXPLAINED, NEAR = 0.6, 0.01  # Share of the outline that lies on its circle, as near as this share of the radius
ONE_SIDED = 0.5  # Length of the mean of unit vectors from its center: an arc of 220 degrees; 0 for opposite arcs
ANOTHER = 0.1  # Another image in the frame has at least this share of the area of the largest


@dataclass(frozen=True)
class Outside:
    """What of a frame is not the endoscope image."""

    mask: Mask  # (H, W)
    sharpness: float = 1.0  # share 0..1 of the outline that is sharp; below `CERTAIN` the border is uncertain
    level: float = 0.0  # brightness 0..255 that it does not exceed
    images: int = 1  # number of images in the frame, of which the largest is taken
    moves: bool = False  # whether single samples show less: see `hidden_by_moving_border`


def find_outside(images: Sequence[Image], inside: Mask | None = None) -> Outside:
    """Detect what shows nothing, at the edge or outside of a known border.

    Args:
        images: K samples (H, W, 3) of one size.
        inside: (H, W) True inside of a border that is known already; None for all.
    """
    grays = [blurred(largest_channel(image)) for image in images]
    inside = np.ones(grays[0].shape, bool) if inside is None else inside
    darkness = find_darkness(reduced(grays)[0])
    if darkness is None or darkness.level >= MAX_LEVEL or not inside.any():
        return Outside(np.zeros_like(inside))
    rank = int(IN_SAMPLES * (len(grays) - 1))
    usual = np.partition(np.stack(grays), rank, axis=0)[rank]
    small = reduced([usual])[0][0]
    size = small.shape[::-1]
    view = cv2.resize(inside.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    tried = [_cut(small, level, darkness, view) for level in _levels(small, darkness)]
    best = max(cut.sharpness for cut in tried)
    alike = [cut.level for cut in tried if cut.mask.any() and cut.sharpness >= best - ALIKE]
    if not alike:
        return Outside(np.zeros_like(inside))
    found = _cut(usual, alike[len(alike) // 2], darkness, inside)
    found = replace(found, mask=dilated(found.mask, disk(_rim(usual, found.mask, inside))) & inside)
    moved = [hidden_by_moving_border(image, found.level, inside & ~found.mask).mean() for image in images]
    return replace(found, moves=float(np.median(moved)) > MOVES)


def hidden_by_moving_border(image: Image, level: float, inside: Mask) -> Mask:
    """(H, W) True where one image (H, W, 3) shows nothing though others do there: the border moves, as in a video of a
    screen.

    Args:
        level: of `Outside`.
        inside: (H, W) True where the clip shows something.
    """
    found = _cut(blurred(largest_channel(image)), level, Darkness(0.0, level / 4), inside).mask
    return dilated(found, square(MIN_REACH_PX)) & inside if found.any() else found


def _levels(usual: Image, darkness: Darkness) -> list[float]:
    """Levels that may separate the outside, ascending."""
    first = darkness.level + darkness.step
    lit = usual[usual > first]
    last = max(MAX_SHARE * float(np.median(lit)) if lit.size else 0.0, first)
    return [first * LEVEL_STEP**i for i in range(int(np.log(last / first) / np.log(LEVEL_STEP)) + 1)]


def _cut(gray: Image, level: float, darkness: Darkness, inside: Mask) -> Outside:
    """What is outside if only what is brighter than `level` shows something."""
    reach = _reach(gray)
    core = cv2.morphologyEx(((gray > level) & inside).astype(np.uint8), cv2.MORPH_OPEN, disk(reach)) > 0
    regions, boxes = components(core, 4)
    areas = boxes[1:, AREA]
    if not areas.size or areas.max() < MIN_PICTURE * gray.size:
        return Outside(np.zeros_like(inside), 0.0, level)
    picture = regions == 1 + int(areas.argmax())
    hull = np.zeros(gray.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.argwhere(picture)[:, ::-1].astype(np.int32)), 1)
    convex = (hull > 0) & inside
    low, high = (change(gray, square(reach)).astype(np.float32) for change in (cv2.erode, cv2.dilate))
    beside = cv2.dilate(cv2.blur(gray, (2 * reach + 1,) * 2), square(3 * reach))
    sharp = high >= np.maximum(np.maximum(RATIO * low, low + 4 * darkness.step), MAX_OF * beside)
    around, notch = inside & ~convex, convex & ~picture
    distance = distance_inside(np.pad(convex, 1))[1:-1, 1:-1]  # the edge of the image counts
    cut, cut_line, cut_clear = _parts(around, around & dilated(convex, square(1)), sharp)
    edge = notch & dilated(picture, square(1)) & (distance > reach)
    notches, line, clear = _parts(notch, edge, sharp, distance)
    others = int((areas >= ANOTHER * areas.max()).sum())
    return Outside(cut | notches, (cut_clear + clear) / max(cut_line + line, 1), level, others)


def _parts(
    dark: Mask, outline: Mask, sharp: Mask, distance: NDArray[np.float32] | None = None
) -> tuple[Mask, int, int]:
    """The parts of `dark` that are outside, and the length of their outline and of its sharp part, px. Those that cut
    into the image have a distance to its convex outline, px.
    """
    regions, boxes = components(dark, 4)
    count = len(boxes)
    line, clear = (np.bincount(regions[where], minlength=count) for where in (outline, outline & sharp))
    chosen = (boxes[:, AREA] >= MIN_OUTSIDE * dark.size) & (line > 0) & (clear >= SHARP * line)
    if distance is not None:
        depth = np.zeros(count, np.float32)
        np.maximum.at(depth, regions[dark], distance[dark])
        chosen &= np.bincount(regions[dark & (distance < 1.5)], minlength=count) > FLAT * depth
    chosen[0] = False
    return regions_where(chosen, regions), int(line[chosen].sum()), int(clear[chosen].sum())


def _reach(gray: Image) -> int:
    return max(MIN_REACH_PX, round(REACH * max(gray.shape)))


def _rim(usual: Image, outside: Mask, inside: Mask) -> int:
    """Width of the darkened or blurred rim next to the outside, px."""
    reach = _reach(usual)
    distance = distance_inside(~outside)
    deep = usual[(distance > MAX_RIM * reach) & (distance < 2 * MAX_RIM * reach) & inside]
    level = float(np.median(deep)) if deep.size else 0.0
    for width in range(1, MAX_RIM * reach):
        ring = usual[(distance >= width) & (distance < width + 1) & inside]
        if not ring.size or np.median(ring) >= FADED * level:
            return width
    return reach


BLACK_LEVEL = 28  # Levels 0..255 below this are black, including limited-range video with coding noise
MIN_STRIP_PX = 3  # Thinner strips are ignored; they can be coding noise
MAX_STRIP_FRACTION = 0.25  # Largest share of the image for one strip
STATIC_RATIO = 0.3  # The change over time of a strip is below this share of the change in the image center ...
STRIP_CHROMA = 40  # ... and a strip is gray: the channels of half of its pixels differ by less than this.
EDGE_SHARE, EDGE_STEP = 0.55, 12
"""Share of a strip's edge with a brightness step, and its least levels: unlike that of a shadow, it is straight."""
FADING, MAX_FADING_PX = 0.8, 3
"""So many rows next to a strip belong to it if they have less than this share of the level two rows further inside."""


@dataclass(frozen=True)
class Strips:
    """Rows and columns at each side that are outside of the endoscope image, px."""

    top: int
    bottom: int
    left: int
    right: int

    def __bool__(self) -> bool:
        return any((self.top, self.bottom, self.left, self.right))


@dataclass(frozen=True)
class Outline:
    """Where the endoscope image ends, judging by the images alone."""

    strips: Strips
    circle: Circle | None
    in_strip: Mask  # (H, W) True in the strips
    other: Outside  # what else is outside: a border that is no circle, or black parts inside of the circle
    outside: Mask  # (H, W) True outside of the circle, on its rim, and on `other`

    @property
    def found(self) -> bool:
        """Whether the endoscope image ends before the frame does."""
        return bool(self.strips or self.outside.any())


def find_outline(images: Sequence[Image]) -> Outline:
    """Detect strips and a border of any shape in (H, W, 3) sample images.

    A circle that only an arc of the border lies on is none: the end of an oval, whose center is far from the circle's.
    """
    circle = find_circle(images)
    found = _outline(images, circle)
    return found if circle is None or _explains(circle, found) else _outline(images, None)


def _outline(images: Sequence[Image], circle: Circle | None) -> Outline:
    """The outline within a circle, None for all of the image."""
    height, width = images[0].shape[:2]
    strips = find_strips(images, circle)
    in_strip = np.ones((height, width), bool)
    in_strip[strips.top : height - strips.bottom, strips.left : width - strips.right] = False
    inside = circle.mask(width, height, circle.margin_px) if circle else np.ones((height, width), bool)
    other = find_outside(images, inside & ~in_strip)
    return Outline(strips, circle, in_strip, other, ~inside | other.mask)


def _explains(circle: Circle, outline: Outline) -> bool:
    """Whether most of the outline lies on the circle, or opposite parts do; edges of frame and strips do not count."""
    shown = ~(outline.outside | outline.in_strip)
    y, x = np.nonzero(shown & dilated(~shown, square(1)) & ~dilated(outline.in_strip, square(1)))
    if not len(x):
        return True
    toward = np.stack([x + 0.5 - circle.center_x, y + 0.5 - circle.center_y], 1)
    distance = np.linalg.norm(toward, axis=1)
    on = np.abs(distance - (circle.radius - circle.margin_px)) < max(NEAR * circle.radius, 2.0)
    one_sided = np.linalg.norm((toward[on] / distance[on, None]).mean(0)) if on.any() else 1.0
    return bool(on.mean() > MIN_EXPLAINED or one_sided < ONE_SIDED)


def masked_border(outline: Outline, images: Sequence[Image], tissue_masks: Iterable[Mask]) -> Mask:
    """(H, W) True where no frame is tissue, and no sample image shows anything: black, or beyond the outline."""
    masked = outline.in_strip | outline.outside | (np.maximum.reduce(images).max(-1) < BLACK_LEVEL)
    for tissue in tissue_masks:
        masked &= ~tissue
    return masked


def find_strips(images: Sequence[Image], circle: Circle | None = None) -> Strips:
    """Detect black bars and static gray console strips at the sides; of a single image only black bars. What lies
    outside of the circle is no strip and hides none.
    """
    grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in images]
    mean = sum(grays) / len(grays)
    change = np.sqrt(sum((gray - mean) ** 2 for gray in grays) / len(grays))
    spans = [largest_channel(image) - smallest_channel(image) for image in images]
    chroma = sum(span.astype(np.float32) for span in spans) / len(images)
    brightest = np.maximum.reduce([largest_channel(image) for image in images])
    height, width = brightest.shape
    central_change = float(np.median(change[height // 4 : height - height // 4, width // 4 : width - width // 4]))
    inside = circle.mask(width, height, circle.margin_px) if circle else np.ones((height, width), bool)
    maps = brightest, chroma, change, mean, inside
    top, bottom, right, left = (  # turned so that the side in question is on top
        _strip_on_top([np.rot90(each, turns) for each in maps], central_change) for turns in (0, 2, 1, 3)
    )
    return Strips(top, bottom, left, right)


def _strip_on_top(maps: list[NDArray], central_change: float) -> int:
    """Number of rows of a strip at the top of these (H, W) maps, 0 for none."""
    brightest, chroma, change, mean, inside = maps
    limit = int(MAX_STRIP_FRACTION * len(brightest))
    first = int(inside.any(1).argmax())  # rows above show nothing of the circle
    rows = first
    while rows <= limit:
        at = inside[rows]
        black = np.quantile(brightest[rows][at], 0.98) < BLACK_LEVEL
        static = np.quantile(change[rows][at], 0.8) < STATIC_RATIO * central_change  # False for one image
        if not (black or (static and np.median(chroma[rows][at]) < STRIP_CHROMA)):
            break
        rows += 1
    if rows < MIN_STRIP_PX or rows == first or rows > limit:
        return 0
    # A row of coding noise can lie between strip and image.
    jumps = [
        np.abs(mean[row] - mean[rows - 1])[inside[rows - 1] & inside[row]] > EDGE_STEP
        for row in range(rows, min(rows + 2, len(mean)))
    ]
    if max((jump.mean() for jump in jumps if jump.size), default=0.0) <= EDGE_SHARE:
        return 0
    beside = slice(rows, rows + 6)
    level = [np.median(row[at]) if at.any() else 0.0 for row, at in zip(mean[beside], inside[beside], strict=True)]
    fading = 0
    while fading < min(MAX_FADING_PX, len(level) - 3) and level[fading] < FADING * level[fading + 2]:
        fading += 1
    return rows + fading
