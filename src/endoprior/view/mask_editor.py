"""Corrections of tool masks: brush strokes, carrying to other frames, undo, saving; and the brush that makes them.

A browser reports where the pointer is dragged only if it drags an object of the scene. A sphere around everything,
beyond the farthest distance that browsers render, is such an object: always under the pointer, never visible.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.checks import frame_list, number_ranges
from ..data import FrameSequence
from ..data.edit import replace_masks
from ..data.found_tools import drop_rows
from ..footage.carry_masks import CarriedEdit, carry_mask_edit
from ..tool_masks.clicked_tools import SearchStep, ToolClick, find_clicked, free_clicked
from .incoming import BRUSH_NODE, JobQueue

if TYPE_CHECKING:
    import viser


MAX_UNDO = 100
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
        self._undo = [*self._undo, self._state][-MAX_UNDO:]

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
        """Search every frame for the tool at a click that the masks miss; give what is found to `change`.

        Raises:
            InputError: the click is not in the image, or on a mask.
        """
        return find_clicked(self._sequence, [click], self.tool)

    def free(self, click: ToolClick) -> Iterator[SearchStep]:
        """Search every frame for the tissue at a click that the masks take for a tool; give it to `change`.

        Raises:
            InputError: the click is not in the image, or not on a mask.
        """
        return free_clicked(self._sequence, [click], self.tool)

    def change(self, regions: Masks, paint: bool) -> None:
        """Add regions to the masks of some frames, or remove them, as one step. Strokes not carried yet stay so."""
        self.begin()
        changed = {i: self.tool(i) | mask if paint else self.tool(i) & ~mask for i, mask in regions.items()}
        masks = self._state.masks | changed
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


def stroke(tool_mask: Mask, points: Sequence[tuple[float, float]], radius: float, paint: bool) -> Mask:
    """A copy of a tool mask with a brush stroke.

    Args:
        points: (x, y) through which the center of the brush moves, px; (0, 0) is the upper left corner of the image.
        radius: of the brush, px; at least one pixel is changed.
        paint: True adds pixels, False removes them.
    """
    drawn = np.zeros(tool_mask.shape, np.uint8)
    # Sixteenths of a pixel; OpenCV counts pixel centers from 0. Positions far outside would overflow.
    limit = 4 * max(tool_mask.shape)
    fixed = np.rint(16 * (np.clip(points, -limit, limit) - 0.5)).astype(np.int32)
    cv2.polylines(drawn, [fixed], False, 1, max(round(2 * radius), 1), cv2.LINE_8, 4)
    for point in fixed.tolist():
        cv2.circle(drawn, point, round(16 * radius), 1, -1, cv2.LINE_8, 4)
    return tool_mask | (drawn > 0) if paint else tool_mask & (drawn == 0)


SPHERE_MM = 5000.0
"""Radius of the sphere; browsers render up to 1000."""
ERASING_KEY: Final = "shift"

Spot = tuple[int, tuple[float, float]]
"""A frame, and a position in its mask, px."""


class BrushControls(Protocol):
    """The controls of the panel that the editor reads, and the text in which it reports."""

    find: viser.GuiCheckboxHandle
    erase: viser.GuiCheckboxHandle
    radius: viser.GuiSliderHandle
    corrected: viser.GuiMarkdownHandle


class MaskEditor:
    """Corrects tool masks while the panel says so. All methods but the callbacks run in the thread of `Viewer.work`."""

    def __init__(
        self,
        edits: MaskEdits,
        controls: BrushControls,
        scene: viser.SceneApi,
        jobs: JobQueue,
        spot: Callable[[viser.ClientHandle, tuple[float, float]], Spot | None],
        changed: Callable[[], None],
    ) -> None:
        """Wait for `listen`.

        Args:
            spot: gives what is at a position (x, y) on a browser's canvas; None in a view that is not of the endoscope.
            changed: called after each change of a mask.
        """
        self.edits, self._controls, self._scene, self._jobs = edits, controls, scene, jobs
        self._spot, self._changed = spot, changed
        self._last: dict[int, Spot] = {}
        """Where each browser's stroke is."""
        self._listens = False
        self._search: Iterator[SearchStep] | None = None
        self._say("")

    def listen(self, active: bool) -> None:
        """Paint where the pointer goes, or leave the pointer to the camera."""
        if active == self._listens:
            return
        self._listens = active
        self._last.clear()
        if not active:
            self._scene.remove_click_callback(self._on_click)
            self._scene.remove_by_name(BRUSH_NODE)
            return
        sphere = self._scene.add_icosphere(
            BRUSH_NODE, SPHERE_MM, subdivisions=1, side="double", cast_shadow=False, receive_shadow=False
        )
        for key in (None, ERASING_KEY):
            sphere.on_drag("left", modifier=key)(self._on_drag)
            cast("Any", self._scene.on_click(modifier=key))(self._on_click)  # its types know no asynchronous ones

    # Callbacks in viser's threads. Asynchronous ones are called in order.

    async def _on_drag(self, event: viser.SceneNodeDragEvent) -> None:
        self._jobs.put(lambda: self._drag(event))

    async def _on_click(self, event: viser.SceneClickEvent) -> None:
        self._jobs.put(lambda: self._dab(event))

    def _drag(self, event: viser.SceneNodeDragEvent) -> None:
        """Continue a stroke; begin it if it is new. It stays in the frame in which it began."""
        browser, here = event.client_id, self._spot(event.client, event.end_screen_pos)
        if event.phase == "start":
            self._last.pop(browser, None)
            if (began := self._spot(event.client, event.start_screen_pos)) is not None and self._listens:
                self.edits.begin()
                self._last[browser] = began
        if here is None or (last := self._last.get(browser)) is None:
            return
        frame, before = last
        self._draw(frame, [before, here[1]], event.modifier == ERASING_KEY)
        self._last[browser] = frame, here[1]
        if event.phase == "end":
            del self._last[browser]

    def _dab(self, event: viser.SceneClickEvent) -> None:
        """A stroke of one point, or a search for the tool or the tissue there."""
        if self._listens and (here := self._spot(event.client, event.screen_pos)) is not None:
            if self._controls.find.value:
                self.find(*here, paint=self._paints(event.modifier == ERASING_KEY))
                return
            self.edits.begin()
            self._draw(here[0], [here[1]], event.modifier == ERASING_KEY)

    def _paints(self, erasing_key: bool) -> bool:
        return self._controls.erase.value == erasing_key  # the key reverses the control

    def _draw(self, frame: int, points: list[tuple[float, float]], erasing_key: bool) -> None:
        self.edits.draw(frame, points, self._controls.radius.value, self._paints(erasing_key))
        self._say("")

    # Searching. A frame is searched in a job of its own, so that the page stays responsive between two of them.

    def find(self, frame: int, place: tuple[float, float], paint: bool = True) -> None:
        """Search all frames for what is at a place (x, y) of a mask, px, in place of a search that is on.

        Args:
            paint: it is a tool, to be masked; else tissue, to be freed.
        Raises:
            InputError: that place is masked already, or not masked.
        """
        click = ToolClick(frame, *place)
        self._search = search = self.edits.find(click) if paint else self.edits.free(click)
        self._continue(search, {}, paint)

    def _continue(self, search: Iterator[SearchStep], found: Masks, paint: bool) -> None:
        """Search one more frame, unless the search was stopped; when all are, change the masks by what was found."""
        if search is not self._search:
            return
        try:
            step = next(search, None)
        except Exception:  # shown by the viewer; the search is over
            self._search = None
            self._say("")
            raise
        if step is not None:
            if step.frame is not None and step.region is not None and step.region.any():
                found[step.frame] = step.region
            what = "Finding the tool" if paint else "Following the tissue"
            self._controls.corrected.content = f"{what}: {step.done} of {step.total}. *Undo* stops."
            self._jobs.put(lambda: self._continue(search, found, paint), surely=True)
            return
        self._search = None
        if found:
            self.edits.change(found, paint)
        self._say(f"{'Found' if paint else 'Freed'} in {frame_list(sorted(found))}." if found else "Nothing was found.")

    # Buttons.

    def undo(self) -> None:
        """Stop a search, or go back by one stroke, one carrying or one search."""
        if self._search is not None:
            self._search = None
            self._say("Stopped.")
        else:
            self._say("" if self.edits.undo() else "Nothing to undo.")

    def carry(self, frame: int) -> None:
        """Carry the correction of a frame to those around it, and say what changed and why it stopped."""
        self._controls.corrected.content = "Carrying the correction..."
        done = self.edits.carry(frame)
        changed = f"Changed frames: {number_ranges(done.masks)}." if done.masks else "No frame changed."
        self._say(f"{changed}  \nBackward until {done.before}.  \nForward until {done.after}.")

    def save(self) -> None:
        """Write the changed masks; raises InputError if they cannot be written."""
        frames = self.edits.save()
        self._say(f"Saved: {frame_list(frames)}." if frames else "Nothing to save.")

    def _say(self, text: str) -> None:
        """Show a text and which masks are not saved."""
        unsaved = self.edits.unsaved
        lines = [text, f"Not saved: {frame_list(unsaved)}." if unsaved else ""]
        self._controls.corrected.content = "  \n".join(filter(None, lines))
        self._changed()
