"""Corrections of the tool masks of a sequence folder: brush strokes, carrying to other frames, undo, saving."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data import FrameSequence
from ..data.folder_edits import replace_masks
from ..data.found_tools import drop_rows
from ..footage.carry_masks import CarriedEdit, carry_mask_edit
from ..tool_masks.clicked_tools import SearchStep, ToolClick, find_clicked

MOST_UNDO = 100
"""Number of steps that can be undone."""
Mask = NDArray[np.bool_]
"""(H, W) True on tools."""
Masks = dict[int, Mask]
"""By frame. A mask is never changed, only replaced."""


class _State(NamedTuple):
    masks: Masks
    """Masks that were corrected."""
    uncarried: Masks
    """The masks before the strokes that were not carried yet."""


class MaskEdits:
    """Corrected masks of one sequence. Nothing is written before `save`."""

    def __init__(self, sequence: FrameSequence) -> None:
        self._sequence = sequence
        self._state, self._undo = _State({}, {}), list[_State]()
        self._saved: Masks = {}
        """Masks of files that differ from what `sequence` has read."""

    def tool(self, frame: int) -> Mask:
        """The mask of a frame, with its corrections."""
        found = self._state.masks.get(frame)
        return ~self._sequence.frame(frame).tissue_mask if found is None else found

    @property
    def unsaved(self) -> list[int]:
        """The frames whose mask was changed since it was read or saved."""
        current = self._state.masks
        return sorted(i for i in {*current, *self._saved} if current.get(i) is not self._saved.get(i))

    def begin(self) -> None:
        """Begin a stroke: `undo` goes back to here."""
        self._undo = [*self._undo, self._state][-MOST_UNDO:]

    def draw(self, frame: int, points: Sequence[tuple[float, float]], radius: float, paint: bool) -> None:
        """Continue the stroke through points (x, y), px of the mask, as `stroke`."""
        before = self.tool(frame)
        masks = {**self._state.masks, frame: stroke(before, points, radius, paint)}
        self._state = _State(masks, {frame: before, **self._state.uncarried})

    def carry(self, frame: int) -> CarriedEdit:
        """Carry what was corrected in a frame since the last time to the frames around it."""
        edited = self.tool(frame)
        before = self._state.uncarried.get(frame, edited)
        done = carry_mask_edit(
            lambda i: self._sequence.frame(i).rgb_u8,
            lambda i: before if i == frame else self.tool(i),
            len(self._sequence),
            frame,
            edited,
        )
        if done.masks:
            self.begin()
            uncarried = {i: mask for i, mask in self._state.uncarried.items() if i != frame}
            self._state = _State(self._state.masks | done.masks, uncarried)
        return done

    def find(self, click: ToolClick) -> Iterator[SearchStep]:
        """Search every frame for the tool at a click that the masks miss; give what is found to `add`.

        Raises:
            InputError: the click is not in the image, or on a mask.
        """
        return find_clicked(self._sequence, [click], self.tool)

    def add(self, added: Masks) -> None:
        """Add pixels to the masks of some frames, as one step. Strokes that were not carried yet stay so."""
        self.begin()
        masks = self._state.masks | {i: self.tool(i) | mask for i, mask in added.items()}
        self._state = self._state._replace(masks=masks)

    def undo(self) -> bool:
        """Go back by one stroke, one carrying or one search; False if there is none."""
        if not self._undo:
            return False
        *self._undo, self._state = self._undo
        return True

    def save(self) -> list[int]:
        """Write every changed mask to its file, keep the original once, and note what changed. Returns the frames.

        Their confidence in `tool_masks.json` is removed: a person has looked at them.

        Raises:
            InputError: the folder is read-only, or the disk rejects a file; masks written before it stay written.
        """
        if frames := self.unsaved:
            replace_masks(self._sequence, {frame: self.tool(frame) for frame in frames})
            drop_rows(self._sequence.path, frames)
            self._saved = dict(self._state.masks)
        return frames


def stroke(mask: Mask, points: Sequence[tuple[float, float]], radius: float, paint: bool) -> Mask:
    """A copy of a mask with a brush stroke.

    Args:
        points: (x, y) through which the center of the brush moves, px; (0, 0) is the upper left corner of the image.
        radius: of the brush, px; at least one pixel is changed.
        paint: True adds pixels, False removes them.
    """
    drawn = np.zeros(mask.shape, np.uint8)
    # Sixteenths of a pixel; OpenCV counts pixel centers from 0. Positions far outside would overflow.
    limit = 4 * max(mask.shape)
    fixed = np.rint(16 * (np.clip(points, -limit, limit) - 0.5)).astype(np.int32)
    cv2.polylines(drawn, [fixed], False, 1, max(round(2 * radius), 1), cv2.LINE_8, 4)
    for point in fixed.tolist():
        cv2.circle(drawn, point, round(16 * radius), 1, -1, cv2.LINE_8, 4)
    return mask | (drawn > 0) if paint else mask & (drawn == 0)
