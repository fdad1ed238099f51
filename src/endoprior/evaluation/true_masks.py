"""Scores of a sequence's tool masks against true ones, of all its frames or of some.

Masks are (H, W), True on tools; `counted` is True on the pixels that count.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ..core.checks import InputError, input_error
from ..core.ranges import evenly_spaced
from ..data import FrameSequence
from ..data.description import read_description
from ..data.files import IMAGE_SUFFIXES, files_with
from ..data.frame_files import match_names
from ..data.images import read_color
from ..data.mask_files import MASK_SUFFIXES, demand_known, read_user_mask, rule_of_files, tool_polarity
from ..data.reading import kind_of
from ..footage.border import find_outline
from ..footage.image_operations import Image, Mask, components, dilated, distance_inside
from ..footage.text_network import TextDetector
from ..footage.texts import static_rectangles
from ..system.atomic import write_json
from .context import Evaluation
from .pictures import fingerprint, frames_of_files
from .score import Score

TOLERANCE = 0.0075  # Distance up to which outlines agree, as a share of the image diagonal (Csurka et al., BMVC 2013)
TIP = 0.9  # A tip begins at this share of the tool's length
MIN_TEXT = 0.3
"""A masked region is the panel of a label, not a tool, if text or painted boxes are at least this share of it."""
MIN_RECTANGLE_PX = 7  # Smallest side of a painted rectangle, px
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Rows and columns to half of a pixel's eight neighbors; the other half are the same steps back."""
SCORES_FILE = "mask_scores.json"
SAMPLES = 20  # Largest number of frames in which the border and the polarity of the true masks are looked for
MORE_ALIKE = 0.8
"""An image is of another frame if it differs from that one by less than this share of its difference from its own."""
SCORES = (
    Score(
        "mask_iou", "IoU", "", True, 4,
        "Pixels that both masks mark, over those that either marks.",
        group="masks", hint="1 is identical",
    ),
    Score(
        "missed_area", "missed area", "", False, 4,
        "True tool pixels that are not marked, over the true tool pixels.",
        group="masks", hint="tool that becomes tissue",
    ),
    Score(
        "false_area", "false area", "", False, 4,
        "Marked pixels that are no tool, over the true tool pixels, in frames that show a tool.",
        group="masks", hint="tissue lost around tools",
    ),
    Score(
        "false_share_of_view", "false, no tool", "", False, 4,
        "Marked pixels over the pixels that count, in frames that show no tool.",
        group="masks", hint="share of frames without a tool",
    ),
    Score(
        "boundary_f1", "boundary F1", "", True, 4,
        "Outline pixels within 0.75 % of the image diagonal of the other outline: F1 of precision and recall.",
        group="masks", hint="1: outlines agree",
    ),
    Score(
        "missed_tips", "missed tips", "", False, 4,
        "True pixels of the last 10 % of each tool's length that are not marked, over all such pixels.",
        group="masks", hint="the end that touches tissue",
    ),
)  # fmt: skip
NO_VALUE = {
    "mask_iou": "neither mask marks a tool",
    "missed_area": "no scored frame shows a tool",
    "false_area": "no scored frame shows a tool",
    "false_share_of_view": "every scored frame shows a tool",
    "boundary_f1": "neither mask has an outline",
    "missed_tips": "no tool reaches into the image from its edge",
}
"""Why a score has no value."""


class TrueMasks:
    """The true tool masks of a sequence; they are decoded when they are used."""

    def __init__(self, folder: Path, sequence: FrameSequence) -> None:
        """Find the true mask of each frame that has one, and which value marks tools.

        The folder has mask files of any kind that `read_user_mask` reads; or such files in `masks/`, as a sequence
        folder, where 255 marks tools unless `sequence.json` says otherwise. InputError for files that cannot be used or
        matched, and for images of a sequence folder that show other frames.
        """
        if (kind := kind_of(folder)) != "a folder":
            raise input_error(folder, "a folder of true masks", kind, "correct the path.")
        self.folder = folder / "masks" if kind_of(folder / "masks") == "a folder" else folder
        files = files_with(self.folder, MASK_SUFFIXES)
        if not files:
            fix = "pass the folder that holds the files, or a sequence folder with masks/."
            raise input_error(self.folder, f"mask files ({', '.join(MASK_SUFFIXES)})", "none", fix)
        self._files, self.matched_by = frames_of_files(self.folder, files, sequence, [])
        if self.folder != folder and kind_of(folder / "images") == "a folder":
            _demand_same_frames(folder / "images", self._files, sequence)
        self.indices = sorted(self._files)
        """Frames that have a true mask, ascending."""
        camera = sequence.camera(0)
        self._size = camera.width, camera.height
        self._rule = rule_of_files(files)
        demand_known(self.folder, self._rule, "save masks of tools alone, with 255 on tools.")
        if self.folder != folder:
            self._tool_is_high = read_description(folder / "sequence.json").get("mask_tool_value", 255) == 255
            self.polarity = f"{'high' if self._tool_is_high else 'low'} values mark tools, as in every sequence folder"
        elif self._rule.labels:
            self._tool_is_high, self.polarity = True, self._rule.note
        else:
            some = [self.indices[i] for i in evenly_spaced(len(self.indices), SAMPLES)]
            highs = [read_user_mask(self._files[i], self._size, self._rule) for i in some]
            polarity = tool_polarity("auto", highs, [sequence.frame(i).rgb_u8 for i in some])
            self._tool_is_high, self.polarity = polarity.tool_is_high, polarity.reason

    def tool(self, index: int) -> Mask:
        """(H, W) the true mask of frame `index`, one of `indices`; InputError for a file that cannot be used."""
        return read_user_mask(self._files[index], self._size, self._rule) == self._tool_is_high


def _demand_same_frames(folder: Path, masks: Mapping[int, Path], sequence: FrameSequence) -> None:
    """Raise InputError if most `images` resemble other frames of the sequence more than those their masks are matched
    to. Equal names can be different frames: two folders of one video may start at different times, or skip frames.
    """
    images, (indices, files) = files_with(folder, IMAGE_SUFFIXES), zip(*sorted(masks.items()), strict=True)
    names = [file.name for file in images], [file.stem for file in files]
    try:
        beside = match_names(folder, names[0], range(len(files)), names[1], required=())
    except InputError:  # images of other names cannot tell
        return
    pairs = [(images[image], indices[mask]) for mask, image in beside.files.items()]
    others = {index: _thumbnail(sequence.frame(index).rgb_u8) for index in evenly_spaced(len(sequence), SAMPLES)}
    checked, wrong = evenly_spaced(len(pairs), SAMPLES), []
    for file, index in (pairs[place] for place in checked):
        image = _thumbnail(read_color(file))
        here = np.abs(image - _thumbnail(sequence.frame(index).rgb_u8)).mean()
        distance, nearest = min((np.abs(image - other).mean(), i) for i, other in others.items())
        if distance < MORE_ALIKE * here:
            wrong.append(f"{file.name}, which is more like frame {nearest} than frame {index}")
    if len(wrong) > len(checked) / 2:
        fix = f"name the mask files by the frames of {sequence.path}, from 0, and pass a folder of them alone."
        raise input_error(folder, f"the frames of {sequence.path}", wrong[-1], fix)


def _thumbnail(image: Image) -> NDArray[np.float32]:
    return cv2.resize(image, (64, 48), interpolation=cv2.INTER_AREA).astype(np.float32)


class MaskEvaluation(Evaluation):
    """Scores of the masks of one sequence: of the pixels of all frames together that have a true mask, and of each."""

    def save(self, folder: Path) -> Path:
        """Write `mask_scores.json` and `mask_scores_per_frame.json`; returns the first."""
        file = folder / SCORES_FILE
        write_json(file, {name: getattr(self, name) for name in ("protocol", "scores", "skipped")})
        write_json(folder / "mask_scores_per_frame.json", self.per_frame)
        return file


def score_masks(sequence: FrameSequence, truth: TrueMasks) -> MaskEvaluation:
    """Score the masks of a sequence in every frame that has a true mask; InputError for a file that cannot be used."""
    shape = sequence.camera(0).height, sequence.camera(0).width
    always_found, always_true = np.ones(shape, bool), np.ones(shape, bool)
    for index in truth.indices:
        always_found &= ~sequence.frame(index).tissue_mask
        always_true &= truth.tool(index)
    samples = [sequence.frame(index).rgb_u8 for index in evenly_spaced(len(sequence), SAMPLES)]
    counted = counted_pixels(samples, always_found | always_true)
    total, tools, rows = Counter[str](), 0, []
    for index in truth.indices:
        counts = count(~sequence.frame(index).tissue_mask, truth.tool(index), counted)
        values = {name: value for name, value in scores_of(counts).items() if math.isfinite(value)}
        rows.append({"index": index, "time": index / len(sequence)} | values)
        total, tools = total + counts, tools + bool(counts["tool"])
    protocol = {
        "data": str(sequence.path.resolve()),
        "data_fingerprint": sequence.fingerprint(),
        "truth": str(truth.folder.resolve()),
        "truth_fingerprint": fingerprint(truth.folder, MASK_SUFFIXES),
        "truth_matched_by": truth.matched_by,
        "truth_polarity": truth.polarity,
        "frames": truth.indices,
        "frames_with_a_tool": tools,
        "share_of_pixels_left_out": float(1 - counted.mean()),
        "boundary_tolerance_px": float(TOLERANCE * np.hypot(*shape)),
        "tip": f"distance from the edge inside the tool, at least {TIP:g} of the largest",
    }
    result = MaskEvaluation(protocol, per_frame=rows)
    for name, value in scores_of(total).items():
        result.add(name, value, NO_VALUE[name])
    return result


def count(found: Mask, truth: Mask, counted: Mask) -> Counter[str]:
    """Compare the mask of one frame with the true one. Counts of several frames can be added.

    Returns:
        Numbers of pixels: true tools (`tool`), their outline and tips (`true_outline`, `tip`), `outline` of what is
        marked; `_hit`, those of them that are marked, or outlines near the other one; `false_beside_tool` and
        `false_without_tool`, marked, but no tool, in frames that show one and in others; `view_without_tool`, all that
        count in the others.
    """
    found, truth = found & counted, truth & counted
    outline, true_outline, tip = boundary(found, counted), boundary(truth, counted), tips(truth, counted)
    pixels = {
        "tool": truth,
        "hit": found & truth,
        "outline": outline,
        "outline_hit": outline & near(true_outline),
        "true_outline": true_outline,
        "true_outline_hit": true_outline & near(outline),
        "tip": tip,
        "tip_hit": tip & found,
    }
    if truth.any():
        pixels["false_beside_tool"] = found & ~truth
    else:
        pixels |= {"false_without_tool": found, "view_without_tool": counted}
    return Counter({name: int(mask.sum()) for name, mask in pixels.items()})


def scores_of(pixels: Counter[str]) -> dict[str, float]:
    """The value of each of `SCORES` by `count`; NaN where there is none (`NO_VALUE`)."""

    def ratio(part: int, whole: int) -> float:
        return part / whole if whole else math.nan

    tool, beside, without = (pixels[name] for name in ("tool", "false_beside_tool", "false_without_tool"))
    precision = pixels["outline_hit"] / max(pixels["outline"], 1)
    recall = pixels["true_outline_hit"] / max(pixels["true_outline"], 1)
    f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    return {
        "mask_iou": ratio(pixels["hit"], tool + beside + without),
        "missed_area": ratio(tool - pixels["hit"], tool),
        "false_area": ratio(beside, tool),
        "false_share_of_view": ratio(without, pixels["view_without_tool"]),
        "boundary_f1": f1 if pixels["outline"] or pixels["true_outline"] else math.nan,
        "missed_tips": ratio(pixels["tip"] - pixels["tip_hit"], pixels["tip"]),
    }


def counted_pixels(images: Sequence[Image], always_masked: Mask) -> Mask:
    """(H, W) True on the pixels that count: all but the border around the endoscope image and burned-in labels.

    A pixel is left out if both hold:
    - the masks, or the true masks, mark it in every frame. One of them is enough: prepared masks hold the border, and
      most true masks do not;
    - the images show nothing of the body there. It lies in a strip at a side or outside of a round border
      (`footage.border.find_outline`), or on a label with its panel, which is burned-in text (`footage.texts`) or
      a rectangle that `prepare --blank` painted, or it is exactly black in all images.

    So a tool that is static in the whole clip counts. A dark shaft does, too: a camera's black has noise. Pixels
    within `TOLERANCE` of those left out do not count either: masks of one border differ by a few pixels.

    Args:
        images: (H, W, 3) samples of the whole clip.
        always_masked: (H, W) True where the masks, or the true masks, mark every frame.
    """
    outline = find_outline(images)
    black = ~np.maximum.reduce(images).any(-1)
    border = outline.in_strip | outline.outside | black
    return ~near(always_masked & (border | _labels(images, black, border, always_masked)))


def _labels(images: Sequence[Image], black: Mask, border: Mask, always_masked: Mask) -> Mask:
    """(H, W) True on burned-in text, on painted rectangles, and on always masked regions that they cover largely."""
    boxes = static_rectangles(images, TextDetector().find) if (always_masked & ~border).any() else []
    for x, y, width, height, area in components(black, 4)[1][1:].tolist():
        if area == width * height and min(width, height) >= MIN_RECTANGLE_PX:  # a dark tool has another shape
            boxes.append((x, y, width, height))
    text = np.zeros_like(always_masked)
    for x, y, width, height in boxes:
        text[y : y + height, x : x + width] = True
    regions, _ = components(always_masked, 4)
    pixels, of_text = (np.bincount(part, minlength=regions.max() + 1) for part in (regions.ravel(), regions[text]))
    return text | ((of_text >= MIN_TEXT * pixels)[regions] & always_masked)


def boundary(mask: Mask, counted: Mask) -> Mask:
    """(H, W) True on the mask's pixels with one of four neighbors that counts and is not in the mask. Edges of the
    image and of the pixels that count are no outline.
    """
    mask = mask & counted
    return mask & dilated(counted & ~mask, CROSS)


def near(pixels: Mask) -> Mask:
    """(H, W) True within `TOLERANCE` of any of the pixels."""
    if not pixels.any():
        return np.zeros_like(pixels)
    return distance_inside(~pixels) <= TOLERANCE * np.hypot(*pixels.shape)


def tips(truth: Mask, counted: Mask) -> Mask:
    """(H, W) True on the tips of tools: the last 10 % of their length, seen from where they enter the image.

    A tool is a region of `truth` (8 neighbors) in contact with the edge of the image, or with the border around it.
    The distance of a pixel is the length of the shortest path to the contact inside the region; the tip has at
    least 0.9 of the region's largest distance. Regions without contact have no tip. Tools that touch are one region.
    """
    truth = truth & counted
    parts, _ = components(np.pad(~counted, 1, constant_values=True), 4)
    outside = parts == parts[0, 0]  # a rim around the image, and what does not count and hangs together with it
    distance = _distance_from_entry(truth, truth & dilated(outside, CROSS)[1:-1, 1:-1])
    regions, _ = components(truth)
    reached = np.isfinite(distance)
    farthest = np.zeros(regions.max() + 1)
    np.maximum.at(farthest, regions[reached], distance[reached])
    length = farthest[regions]
    return reached & (length > 0) & (distance >= TIP * length)


def _distance_from_entry(region: Mask, entry: Mask) -> NDArray[np.float64]:
    """(H, W) length of the shortest path in `region` to a pixel of `entry`, px; infinite where there is none."""
    distance = np.full(region.shape, np.inf)
    if not entry.any():
        return distance
    number = np.full(np.add(region.shape, 2), -1)
    inner = number[1:-1, 1:-1]
    inner[region] = np.arange(region.sum())
    starts, ends, lengths = [], [], []
    for down, right in STEPS:
        neighbor = np.roll(number, (-down, -right), (0, 1))[1:-1, 1:-1]
        both = region & (neighbor >= 0)
        starts.append(inner[both])
        ends.append(neighbor[both])
        lengths.append(np.full(int(both.sum()), np.hypot(down, right)))
    places = np.concatenate(starts), np.concatenate(ends)
    graph = coo_array((np.concatenate(lengths), places), shape=(int(region.sum()),) * 2).tocsr()
    distance[region] = dijkstra(graph, directed=False, indices=inner[entry], min_only=True)
    return distance
