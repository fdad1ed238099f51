"""The controls beside the picture: what they are called, what they offer. Built once; `server` listens to them."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .guard import are_numbers
from .session import Layer, Look
from .subject import Subject

if TYPE_CHECKING:
    import viser

LAYER_NAMES: dict[Layer, str] = {
    "color": "Color",
    "depth": "Depth",
    "alpha": "Alpha",
    "motion": "Motion",
    "prior": "Texture prior",
    "frame": "Original frame",
    "difference": "Difference",
}
ENDOSCOPE, ORBIT = "Endoscope", "Orbit"
SERVER, BROWSER = "Server (exact)", "Browser (smooth)"
SPLATS, POINTS = "Splats", "Points"
ORIGINALS = ("frame", "difference")
SPEEDS = ("0.1x", "0.25x", "0.5x", "1x", "2x", "4x")
CLIP_MARGIN = 1.5
"""The clipping slider ends at this multiple of the far depth; there, nothing is clipped."""


class Panel:
    """Every control, by name."""

    def __init__(self, gui: viser.GuiApi, subject: Subject, uplot: Any) -> None:
        """Build the controls for what `subject` can show. `uplot` is viser's module of chart types."""
        total, trained = len(subject.cameras), "color" in subject.layers
        self.status = gui.add_markdown("")
        self.frame = gui.add_slider("Frame", 0, max(total - 1, 1), 1, 0, disabled=total < 2)
        self.play = gui.add_button("Play", disabled=total < 2)
        self.speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1x")
        with gui.add_folder("Show"):
            names = [LAYER_NAMES[layer] for layer in subject.layers]
            self.layer = gui.add_dropdown("Layer", names, initial_value=names[0])
            self.camera = gui.add_dropdown("Camera", (ENDOSCOPE, ORBIT), initial_value=ENDOSCOPE)
            self.drawn_by = gui.add_dropdown("Drawn by", (SERVER, BROWSER), initial_value=SERVER, visible=trained)
            self.drawn_as = gui.add_dropdown("Drawn as", (SPLATS, POINTS), initial_value=SPLATS, visible=trained)
            self.tool = gui.add_checkbox("Tool overlay", False, visible=subject.has_tool)
            self.tracks = gui.add_checkbox("Material tracks", False)
            self.clip_end = float(np.ceil(CLIP_MARGIN * subject.span[1])) or 1.0
            step = 10.0 ** np.floor(np.log10(self.clip_end / 100))
            unit = "relative" if subject.relative else "mm"
            self.clip = gui.add_multi_slider(
                f"Depth range, {unit}", 0.0, self.clip_end, float(step), (0.0, self.clip_end)
            )
        with gui.add_folder("Measure"):
            self.measure = gui.add_checkbox("Measure by clicking", False)
            self.clear = gui.add_button("Clear measurement")
            self.distance = gui.add_markdown("")
            axis = np.arange(total, dtype=np.float64)
            series = (uplot.Series(label="frame"), uplot.Series(label=unit, stroke="orange", width=2))
            scales = {"x": uplot.Scale(time=False)}
            self.chart = gui.add_uplot((axis, np.zeros(total)), series, scales=scales, height=160, visible=False)
        with gui.add_folder("Save"):
            self.screenshot = gui.add_button("Screenshot (PNG)")
            self.keep = gui.add_button("Keep this view", hint="The film goes through the views kept, in this order.")
            self.forget = gui.add_button("Forget the views")
            self.film = gui.add_button("Film (MP4)", hint="All frames from here, or through the views kept.")

        self._allowed = self._values()

    def _values(self) -> dict[str, Callable[[Any], bool]]:
        """By the id of a control, whether it can have a value."""
        found: dict[str, Callable[[Any], bool]] = {}

        def allow(rule: Callable[[Any], bool], *handles: Any) -> None:
            found.update({handle._impl.uuid: rule for handle in handles})

        def choice(handle: Any) -> None:
            allow(lambda value: isinstance(value, str) and value in handle.options, handle)

        last, end = self.frame.max, self.clip_end
        allow(lambda value: are_numbers([value], 1, last) and value >= 0, self.frame)
        allow(lambda value: are_numbers(value, 2, end) and min(value) >= 0, self.clip)
        allow(lambda value: isinstance(value, bool), self.tool, self.tracks, self.measure)
        allow(lambda value: isinstance(value, bool), self.play, self.clear, self.screenshot, self.keep, self.forget)
        allow(lambda value: isinstance(value, bool), self.film)
        for handle in (self.speed, self.layer, self.camera, self.drawn_by, self.drawn_as):
            choice(handle)
        return found

    def accepts(self, uuid: str, value: Any) -> bool:
        """Whether the control of this id can have this value; False if there is no such control."""
        rule = self._allowed.get(uuid)
        return rule is not None and rule(value)

    @property
    def rate(self) -> float:
        """How many times faster than it was filmed."""
        return float(self.speed.value.removesuffix("x"))

    def chosen(self, look: Look) -> Look:
        """`look` with everything under Show as it is set now."""
        layers = {name: layer for layer, name in LAYER_NAMES.items()}
        near, far = self.clip.value
        return replace(
            look,
            layer=layers[self.layer.value],
            endoscope=self.camera.value == ENDOSCOPE,
            in_browser=self.drawn_by.value == BROWSER,
            points=self.drawn_as.value == POINTS,
            tool=self.tool.value,
            tracks=self.tracks.value,
            near=near,
            far=far if far < self.clip_end else float("inf"),
        )


def plain(text: str) -> str:
    """Text as it is, in the page's Markdown: the name of a folder must not become a picture, a link or a script."""
    shown = "".join(letter if letter.isprintable() else " " for letter in text)
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", shown)


def status(subject: Subject, look: Look, num_kept: int) -> str:
    """What is shown, in a few lines."""
    lines = [f"**{plain(subject.title)}**", f"frame {look.frame} of {len(subject.cameras)}"]
    if legend := subject.legend(look):
        lines.append(legend)
    if look.in_browser and not subject.sent(look):
        lines.append("This layer is drawn by the server.")
    if not look.endoscope and look.layer in ORIGINALS and "color" in subject.layers:
        lines.append("Originals fit the endoscope's view only; color is shown.")
    if subject.relative:
        lines.append("Depth is **relative**: lengths are not mm.")
    if num_kept:
        lines.append(f"{num_kept} views kept")
    return "  \n".join(lines)
