"""True tool masks of a sequence, or of some of its frames, and the scores of the sequence's own masks against them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import InputError, input_error
from ..core.ranges import spread
from ..data import FrameSequence
from ..data.description import read_description
from ..data.files import IMAGE_SUFFIXES, files_with
from ..data.frame_files import match_names
from ..data.images import read_color
from ..data.mask_files import MASK_SUFFIXES, demand_known, read_user_mask, rule_of_files, tool_polarity
from ..data.reading import kind_of
from ..system.atomic import write_json
from .context import Evaluation
from .mask_scores import NO_VALUE, TIP, TOLERANCE, count, counted_pixels, scores_of
from .pictures import fingerprint, frames_of_files

SCORES_FILE = "mask_scores.json"
SAMPLES = 20
"""Largest number of frames in which the border and the polarity of the true masks are looked for."""
MORE_ALIKE = 0.8
"""An image is of another frame if it differs from that one by less than this share of its difference from its own."""


class TrueMasks:
    """The true tool masks of a sequence; they are decoded when they are used."""

    def __init__(self, folder: Path, sequence: FrameSequence) -> None:
        """Find the true mask of each frame that has one, and which value marks tools.

        Args:
            folder: with mask files of any kind that `read_user_mask` reads; or with such files in `masks/`, as a
                sequence folder, where 255 marks tools unless `sequence.json` says otherwise.
            sequence: whose masks are to be scored.
        Raises:
            InputError: no such folder, files that do not match the frames, images of a sequence folder that show other
                frames, or files that cannot be used.
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
            some = [self.indices[i] for i in spread(len(self.indices), SAMPLES)]
            highs = [read_user_mask(self._files[i], self._size, self._rule) for i in some]
            polarity = tool_polarity("auto", highs, [sequence.frame(i).rgb_u8 for i in some])
            self._tool_is_high, self.polarity = polarity.tool_is_high, polarity.reason

    def tool(self, index: int) -> NDArray[np.bool_]:
        """(H, W) True on the tools in frame `index`, one of `indices`.

        Raises:
            InputError: the file cannot be used, or has another size than the frames.
        """
        return read_user_mask(self._files[index], self._size, self._rule) == self._tool_is_high


def _demand_same_frames(folder: Path, masks: Mapping[int, Path], sequence: FrameSequence) -> None:
    """Raise InputError if most images resemble other frames of the sequence more than those they are matched to.

    Equal names can be different frames: two folders of one video may start at different times, or skip frames.

    Args:
        folder: images of the sequence folder with the true masks.
        masks: the true mask of each frame of `sequence` that has one.
    """
    images, (indices, files) = files_with(folder, IMAGE_SUFFIXES), zip(*sorted(masks.items()), strict=True)
    names = [file.name for file in images], [file.stem for file in files]
    try:
        beside = match_names(folder, names[0], range(len(files)), names[1], required=())
    except InputError:  # images of other names cannot tell
        return
    pairs = [(images[image], indices[mask]) for mask, image in beside.files.items()]
    others = {index: _thumbnail(sequence.frame(index).rgb_u8) for index in spread(len(sequence), SAMPLES)}
    checked, wrong = spread(len(pairs), SAMPLES), []
    for place in checked:
        file, index = pairs[place]
        image = _thumbnail(read_color(file))
        here = np.abs(image - _thumbnail(sequence.frame(index).rgb_u8)).mean()
        distance, nearest = min((np.abs(image - other).mean(), i) for i, other in others.items())
        if distance < MORE_ALIKE * here:
            wrong.append(f"{file.name}, which is more like frame {nearest} than frame {index}")
    if len(wrong) > len(checked) / 2:
        fix = f"name the mask files by the frames of {sequence.path}, from 0, and pass a folder of them alone."
        raise input_error(folder, f"the frames of {sequence.path}", wrong[-1], fix)


def _thumbnail(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(48, 64, 3) the image (H, W, 3), 0..255, at a small size."""
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
    """Score the masks of a sequence in every frame that has a true mask.

    Raises:
        InputError: a file cannot be used.
    """
    shape = sequence.camera(0).height, sequence.camera(0).width
    always_found, always_true = np.ones(shape, bool), np.ones(shape, bool)
    for index in truth.indices:
        always_found &= ~sequence.frame(index).tissue_mask
        always_true &= truth.tool(index)
    samples = [sequence.frame(index).rgb_u8 for index in spread(len(sequence), SAMPLES)]
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
