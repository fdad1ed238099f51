"""The brush: pointer and controls of the browsers, applied to `MaskEdits`.

A browser reports where the pointer is dragged only if it drags an object of the scene. A sphere around everything,
beyond the farthest distance that browsers render, is such an object: always under the pointer, never visible.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..core.checks import number_ranges
from ..tool_masks.clicked_tools import SearchStep, ToolClick
from .access_control import BRUSH_NODE
from .job_queue import JobQueue
from .mask_edits import MaskEdits, Masks, carried_text

if TYPE_CHECKING:
    import viser

    from .panel import Panel

SPHERE_MM = 5000.0
"""Radius of the sphere; browsers render up to 1000."""
ERASING_KEY = "shift"

Spot = tuple[int, tuple[float, float]]
"""A frame, and a position in its mask, px."""


class MaskEditor:
    """Corrects tool masks while the panel says so. All methods but the callbacks run in the thread of `Viewer.work`."""

    def __init__(
        self,
        edits: MaskEdits,
        controls: Panel,
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
        self._search: _Search | None = None
        self._say("")

    def listen(self, active: bool) -> None:
        """Paint where the pointer goes, or leave the pointer to the camera."""
        if active == self._listens:
            return
        self._listens = active
        self._last.clear()
        if not active:
            self._scene.remove_click_callback(self._on_click)
            self._scene.remove_click_callback(self._on_erasing_click)
            self._scene.remove_by_name(BRUSH_NODE)
            return
        sphere = self._scene.add_icosphere(
            BRUSH_NODE, SPHERE_MM, subdivisions=1, side="double", cast_shadow=False, receive_shadow=False
        )
        for key, clicked in ((None, self._on_click), (ERASING_KEY, self._on_erasing_click)):
            sphere.on_drag("left", modifier=key)(self._on_drag)
            self._scene.on_click(modifier=key)(clicked)

    # Callbacks in viser's threads. Asynchronous ones are called in order.

    async def _on_drag(self, event: viser.SceneNodeDragEvent) -> None:
        self._jobs.put(lambda: self._drag(event))

    async def _on_click(self, event: viser.SceneClickEvent) -> None:
        self._jobs.put(lambda: self._dab(event, False))

    async def _on_erasing_click(self, event: viser.SceneClickEvent) -> None:
        self._jobs.put(lambda: self._dab(event, True))

    def _drag(self, event: viser.SceneNodeDragEvent) -> None:
        """Continue a stroke; begin it if it is new. It stays in the frame in which it began."""
        here = self._spot(event.client, event.end_screen_pos)
        if event.phase == "start":
            self._last.pop(event.client_id, None)
            if (began := self._spot(event.client, event.start_screen_pos)) is not None and self._listens:
                self.edits.begin()
                self._last[event.client_id] = began
        if here is None or (last := self._last.get(event.client_id)) is None:
            return
        frame, before = last
        self._draw(frame, [before, here[1]], event.modifier == ERASING_KEY)
        self._last[event.client_id] = frame, here[1]
        if event.phase == "end":
            del self._last[event.client_id]

    def _dab(self, event: viser.SceneClickEvent, erasing_key: bool) -> None:
        """A stroke of one point, or a search for the tool there."""
        if self._listens and (here := self._spot(event.client, event.screen_pos)) is not None:
            if self._controls.find.value:
                self.find(*here)
                return
            self.edits.begin()
            self._draw(here[0], [here[1]], erasing_key)

    def _draw(self, frame: int, points: list[tuple[float, float]], erasing_key: bool) -> None:
        paint = self._controls.erase.value == erasing_key  # the key reverses the control
        self.edits.draw(frame, points, self._controls.radius.value, paint)
        self._say("")

    # Searching. A frame is searched in a job of its own, so that the page stays responsive between two of them.

    def find(self, frame: int, place: tuple[float, float]) -> None:
        """Search all frames for the tool at a place (x, y) of a mask, px, in place of a search that is on.

        Raises:
            InputError: that place is masked already.
        """
        self._search = _Search(self.edits.find(ToolClick(frame, *place)))
        self._continue(self._search)

    def _continue(self, search: _Search) -> None:
        """Search one more frame, unless the search was stopped; when all are, add what was found."""
        if search is not self._search:
            return
        try:
            step = next(search.steps, None)
        except Exception:  # shown by the viewer; the search is over
            self._search = None
            self._say("")
            raise
        if step is not None:
            if step.added is not None and step.added.any():
                search.added[step.frame] = step.added
            self._controls.corrected.content = f"Finding the tool: {step.done} of {step.total}. *Undo* stops."
            self._jobs.put(lambda: self._continue(search), surely=True)
            return
        self._search = None
        if search.added:
            self.edits.add(search.added)
        self._say(f"Found in {_frames(sorted(search.added))}." if search.added else "Nothing was found.")

    # Buttons.

    def undo(self) -> None:
        """Stop a search, or go back by one stroke, one carrying or one search."""
        if self._search is not None:
            self._search = None
            self._say("Stopped.")
            return
        self._say("" if self.edits.undo() else "Nothing to undo.")

    def carry(self, frame: int) -> None:
        """Carry the correction of a frame to those around it."""
        self._controls.corrected.content = "Carrying the correction..."
        self._say(carried_text(self.edits.carry(frame)))

    def save(self) -> None:
        """Write the changed masks.

        Raises:
            InputError: they cannot be written.
        """
        frames = self.edits.save()
        self._say(f"Saved: {_frames(frames)}." if frames else "Nothing to save.")

    def _say(self, text: str) -> None:
        """Show a text and which masks are not saved."""
        unsaved = self.edits.unsaved
        lines = [text] if text else []
        if unsaved:
            lines.append(f"Not saved: {_frames(unsaved)}.")
        self._controls.corrected.content = "  \n".join(lines)
        self._changed()


@dataclass(frozen=True)
class _Search:
    """A search for a clicked tool."""

    steps: Iterator[SearchStep]
    added: Masks = field(default_factory=dict)
    """(H, W) by frame, of what was found so far."""


def _frames(numbers: list[int]) -> str:
    """Such as `frames 3-5, 9`."""
    return f"frame{'s' if len(numbers) > 1 else ''} {number_ranges(numbers)}"
