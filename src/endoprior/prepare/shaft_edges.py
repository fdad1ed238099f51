"""The two straight edges of an instrument's shaft in a tool mask, from the border of the view inward, and moved to
where the image changes, to a fraction of a px.

Pixel coordinates: (0, 0) is the upper left corner of the image, the first pixel covers 0..1. H, W image size.

Masks of tools are often a few px too wide. Near a line of the mask, the line is taken along which the colors change
most, all places along it counting alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

INWARD_PX, OUTWARD_PX = 14.0, 4.0  # how far from the line of the mask to look, at a width of 640 px
SAMPLE_PX = 0.5  # between samples across the edge
BLUR_PX = 1.5
COLOR_SHARE_OFFSET = 8  # added to each channel, of 255: the colors of dark pixels are noise
NEAR_PX = 1.5  # of edge points around their line
STRONG = 80.0  # percentile of the changes around a line that counts as much as any stronger change
MIN_EDGE_SHARE = 0.5  # of the places along an edge that must change near the line
MIN_AREA = 0.003  # of the frame: a smaller tool has no long edges
AT_BORDER_PX = 2.5  # so near to the end of the view, outlines follow the border and not the tool
TOLERANCE_PX = 2.0  # of a mask's points around the line of its edge, at a width of 640 px
STRAIGHT_SHARE = 0.8  # of an edge's points that must be within the tolerance
MIN_LENGTH = 0.15  # of an edge, in image widths
MIN_WIDTH = 0.015  # of a shaft, in image widths: below, an error of 1 px of the mask is 10 % of the distance
MIN_ASPECT = 2.5  # of the shorter edge's length to the width of the shaft
MAX_TAPER = 0.35  # angle between the edges, radians: more is a jaw, or a shaft that points at the camera
STEP = 1.15  # from one tried length of an edge to the next
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ShaftEdges:
    """A shaft in one frame; all in px."""

    ends: NDArray[np.float64]
    """(2, 2, 2) x, y of both ends of both edges: [edge, where it enters or where the shaft ends, axis]."""
    inside: NDArray[np.float64]
    """(2,) x, y between them, where both are seen."""
    end: NDArray[np.float64]
    """(2,) x, y of the middle of the shaft where its edges end: beyond may be a wrist."""
    tip: NDArray[np.float64]
    """(2,) x, y of the end of the tool that is farthest from where it enters, along the shaft."""
    width: float
    """Distance between the edges at `inside`."""
    off_axis: float
    """Distance of the tip from the middle line of the shaft: large if the wrist is bent."""


def shafts_of(tools: Mask, outside: Mask, rgb_u8: NDArray[np.uint8] | None = None) -> Iterator[ShaftEdges]:
    """The shafts in a tool mask that are straight and long enough to be measured.

    Args:
        rgb_u8: (H, W, 3) the image, in which edges are found to a fraction of a px; None takes those of the mask.
        tools: (H, W) True on tools.
        outside: (H, W) True where the frame shows nothing, such as beyond a round border; may be all False.
    """
    height, width = tools.shape
    view = np.pad((~outside).astype(np.uint8), 1)  # beyond the image is outside as well
    depth_in_view = np.asarray(cv2.distanceTransform(view, cv2.DIST_L2, 5), np.float32)[1:-1, 1:-1]
    smooth = None if rgb_u8 is None else smoothed(rgb_u8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((tools & ~outside).astype(np.uint8), None, None, None, 8)
    for label in range(1, count):
        if stats[label, cv2.CC_STAT_AREA] >= MIN_AREA * height * width:
            found = _shaft(labels == label, depth_in_view, smooth)
            if found is not None:
                yield found


def _shaft(tool: Mask, depth_in_view: NDArray[np.float32], smooth: NDArray[np.float32] | None) -> ShaftEdges | None:
    """The shaft of one connected tool; None if its edges are not straight, or it does not enter from the border."""
    px = tool.shape[1]
    chain = _free_outline(tool, depth_in_view)
    if chain is None:
        return None
    tolerance = TOLERANCE_PX * max(px / 640, 1.0)
    one, other = (_straight(part, tolerance, MIN_LENGTH * px) for part in (chain, chain[::-1]))
    if one is not None and other is not None and smooth is not None:
        between = np.mean([*one[1], *other[1]], 0)
        one, other = image_edge(smooth, one[1], between), image_edge(smooth, other[1], between)
    if one is None or other is None:
        return None
    (first, ends), (second, other_ends) = one, other
    lengths = [float(np.linalg.norm(np.subtract(*each))) for each in (ends, other_ends)]
    # Where both edges are seen: the middle between the middles of the edges.
    inside = (ends[0] + ends[1] + other_ends[0] + other_ends[1]) / 4
    lines = np.stack([first, second])
    if smooth is None:  # the outline of a mask runs through the centers of its outermost pixels, half a px inside
        lines[:, 2] += 0.5 * np.sign(lines @ [*inside, 1.0])
    width = float(np.abs(lines @ [*inside, 1.0]).sum())
    inward = _unit(ends[1] - ends[0]) + _unit(other_ends[1] - other_ends[0])
    cosine = abs(float(lines[0, :2] @ lines[1, :2]))
    if width < MIN_WIDTH * px or min(lengths) < MIN_ASPECT * width or cosine < np.cos(MAX_TAPER):
        return None
    if np.linalg.norm(inward) < 1:  # the two edges do not run side by side
        return None
    along = _unit(inward)
    progress = chain @ along
    tip = chain[progress >= progress.max() - 2].mean(0)
    off = tip - inside
    off_axis = abs(float(off[0] * along[1] - off[1] * along[0]))
    end = inside + along * float(np.max([(each[1] - inside) @ along for each in (ends, other_ends)]))
    on_lines = [_on_line(line, each) for line, each in zip(lines, (ends, other_ends), strict=True)]
    return ShaftEdges(np.stack(on_lines), inside, end, tip, width, off_axis)


def line_through(ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) a, b, c of the line through two points (2, 2), with a^2 + b^2 = 1."""
    dx, dy = _unit(ends[1] - ends[0])
    return np.array([-dy, dx, dy * ends[0, 0] - dx * ends[0, 1]])


def _fitted_line(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """(3,) a, b, c of the line through points (N, 2), of which some may be off, with a^2 + b^2 = 1."""
    dx, dy, x, y = cv2.fitLine(points, cv2.DIST_HUBER, 0, 0.01, 0.01).ravel().astype(np.float64)
    return np.array([-dy, dx, dy * x - dx * y])


def _on_line(line: NDArray, ends: tuple[NDArray, NDArray]) -> NDArray:
    """(2, 2) the points of a line that are nearest to two points."""
    return np.stack([end - (line @ [*end, 1.0]) * line[:2] for end in ends])


def _free_outline(tool: Mask, depth_in_view: NDArray[np.float32]) -> NDArray[np.float64] | None:
    """(N, 2) the outline of a tool from border to border, at the centers of its outermost pixels; None if it does not
    touch the border in one place.
    """
    contours, _ = cv2.findContours(tool.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = np.asarray(max(contours, key=len), np.intp)[:, 0]
    free = depth_in_view[outline[:, 1], outline[:, 0]] > AT_BORDER_PX
    if free.all() or not free.any():
        return None
    start = int(np.flatnonzero(~free)[0])  # begin at the border, so that no run of free points is cut in two
    outline, free = np.roll(outline, -start, 0), np.roll(free, -start)
    changes = np.flatnonzero(np.diff(np.concatenate([[0], free.view(np.int8), [0]])))
    runs = sorted(zip(changes[::2], changes[1::2], strict=True), key=lambda run: run[1] - run[0])
    begin, end = runs[-1]
    return (outline[begin:end] + 0.5).astype(np.float64) if end - begin >= 0.7 * free.sum() else None


def _straight(chain: NDArray, tolerance: float, least: float) -> tuple[NDArray, tuple[NDArray, NDArray]] | None:
    """The line (3,) along the beginning of an outline (N, 2), as far as it is straight, and its two ends; None if it
    is straight over less than `least` px.
    """
    best, count = None, least
    while count <= len(chain) / 2:
        part = chain[: int(count)].astype(np.float32)
        line = _fitted_line(part)
        near = np.abs(part @ line[:2] + line[2]) <= tolerance
        if near.mean() < STRAIGHT_SHARE or not near[-max(len(near) // 8, 1) :].any():
            break
        on_line = np.flatnonzero(near)
        ends = chain[on_line[0]].astype(np.float64), chain[on_line[-1]].astype(np.float64)
        best = line, ends
        count *= STEP
    if best is None or np.linalg.norm(best[1][1] - best[1][0]) < least:
        return None
    return best


def _unit(vector: NDArray) -> NDArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def image_edge(
    smooth: NDArray[np.float32], ends: tuple[NDArray, NDArray], inside: NDArray
) -> tuple[NDArray, tuple[NDArray, NDArray]] | None:
    """The line (3,), as of `ShaftEdges`, along which an image changes most near a line; and its two ends (2,).

    Args:
        smooth: (H, W, 3) blurred image.
        ends: (2,) x, y of the ends of that line, px.
        inside: (2,) x, y of a place on the side of the tool.
    Returns:
        None if the changes are not on one line.
    """
    scale = max(smooth.shape[1] / 640, 1.0)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    along = (ends[1] - ends[0]) / max(length, 1e-9)
    outward = -np.array([-along[1], along[0]]) * np.sign(
        along[0] * (inside - ends[0])[1] - along[1] * (inside - ends[0])[0]
    )
    places = np.arange(0.0, length + 0.5)
    across = np.arange(-INWARD_PX * scale, OUTWARD_PX * scale + SAMPLE_PX / 2, SAMPLE_PX)
    at = ends[0] + places[:, None, None] * along + across[None, :, None] * outward
    profile = _sampled(smooth, at)
    change = np.abs(np.gradient(profile, SAMPLE_PX, axis=1)).sum(-1)
    change[~((at >= 1) & (at < (smooth.shape[1] - 1, smooth.shape[0] - 1))).all(-1)] = 0
    first, last = _strongest(np.minimum(change, np.percentile(change, STRONG)))
    fit = np.array([(across[last] - across[first]) / max(places[-1], 1.0), across[first]])
    near_line = np.abs(across - np.polyval(fit, places)[:, None]) <= NEAR_PX * scale
    best = np.where(near_line, change, 0).argmax(1)
    there = (change * near_line).max(1) > np.median(change)
    if there.sum() < max(MIN_EDGE_SHARE * len(places), 8):
        return None
    offset = across[best] + SAMPLE_PX * _peak(change, best)
    points = (ends[0] + places[:, None] * along + offset[:, None] * outward)[there].astype(np.float32)
    found = _fitted_line(points)
    begin, end = _on_line(found, ends)
    return found, (begin, end)


def smoothed(rgb_u8: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H, W, 3) shares of red, green and blue without their noise, for `image_edge`: light and shadow do not count."""
    sigma = BLUR_PX * max(rgb_u8.shape[1] / 640, 1.0)
    smooth = np.asarray(cv2.GaussianBlur(rgb_u8.astype(np.float32), (0, 0), sigma), np.float32) + COLOR_SHARE_OFFSET
    return smooth / smooth.sum(-1, keepdims=True)


def _strongest(change: NDArray) -> tuple[int, int]:
    """The columns at the first and the last row of (N, S) between which the line with the largest sum runs."""
    count, samples = change.shape
    share = np.linspace(0, 1, count)
    rows = np.arange(count)
    columns = np.arange(samples)
    best, found = -1.0, (0, 0)
    for first in columns:
        paths = np.rint(first + share[:, None] * (columns - first)).astype(np.intp)
        totals = change[rows[:, None], paths].sum(0)
        last = int(totals.argmax())
        if totals[last] > best:
            best, found = float(totals[last]), (int(first), last)
    return found


def _sampled(image: NDArray[np.float32], at: NDArray) -> NDArray[np.float32]:
    """(N, S, 3) colors at (N, S, 2) x, y; OpenCV counts pixel centers from 0."""
    x, y = (at[..., axis].astype(np.float32) - np.float32(0.5) for axis in (0, 1))
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _peak(change: NDArray, best: NDArray) -> NDArray:
    """(N,) where a parabola through the largest value of each row and its neighbors peaks, in samples from it."""
    rows = np.arange(len(change))
    inner = np.clip(best, 1, change.shape[1] - 2)
    before, here, after = (change[rows, inner + step] for step in (-1, 0, 1))
    bend = before - 2 * here + after
    return np.clip(np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend < 0), -1, 1)
