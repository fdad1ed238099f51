"""The control panel: names and options of its controls. `server` connects their callbacks."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from viser import uplot

from ..core.geometry import length_unit
from ..data.scale import MAX_MM
from .incoming import are_numbers
from .viewable import Layer, ViewSettings

if TYPE_CHECKING:
    import viser

    from .viewable_sequence import Viewable

LAYER_NAMES: dict[Layer, str] = {
    "color": "Color",
    "depth": "Depth",
    "alpha": "Alpha",
    "displacement": "Displacement",
    "stretch": "Stretch",
    "prior": "Texture prior",
    "support": "Seen or guessed",
    "frame": "Original frame",
    "difference": "Difference",
}
ENDOSCOPE, ORBIT = "Endoscope", "Orbit"
SERVER, BROWSER = "Server (exact)", "Browser (smooth)"
SPLATS, POINTS = "Splats", "Points"
DISTANCE, AREA, PATH, DISPLACEMENT, STRETCH = "Distance", "Area", "Path length", "Displacement", "Stretch"
CLEAR, TABLE = "Clear", "Table (CSV)"
IMAGE, VIDEO = "Image (PNG)", "Video (MP4)"
PLY, SLICER, MESH = "PLY", "Slicer", "Mesh"
POINTS_OF = {DISTANCE: (2, 2), AREA: (3, 64), PATH: (1, 1), DISPLACEMENT: (1, 1), STRETCH: (1, 1)}
"""Quantities to measure, with the fewest and most points of each: the next click begins a new measurement."""
SPEEDS = ("0.1x", "0.25x", "0.5x", "1x", "2x", "4x")
CLIP_MARGIN = 1.5
"""The clipping slider ends at this multiple of the far depth; at its end nothing is clipped."""

CHART_HEIGHT = 110
"""Of the chart of what is measured, px: *Save* below it stays in a window 720 px high."""
NARROW_SHEET = '.mantine-Paper-root[style*="position: fixed"][style*="bottom: 0px"]'
"""The panel of viser's page in a window narrower than 576 px: a sheet over the image."""
NARROW_WINDOW = f"""@media (max-width: 36em) {{
  div:has(> {NARROW_SHEET}) {{ flex-direction: column; }}
  div:has(+ {NARROW_SHEET}) {{ flex: 1 1 0 !important; height: auto !important; min-height: 0; }}
  {NARROW_SHEET} {{ position: relative !important; flex: none; width: 100% !important; max-height: 55% !important; }}
  {NARROW_SHEET} [style*="width: 20em"] {{ width: 100% !important; }}
}}"""
"""Puts that sheet below the image; folded, which a touch of its title does, it leaves the image the window."""


def control_id(handle: Any) -> str:
    """The id of a control in viser's messages."""
    return handle._impl.uuid


class Panel:
    """All controls, by name."""

    def __init__(self, gui: viser.GuiApi, viewable: Viewable) -> None:
        """Build the controls that `viewable` supports."""
        total, trained = len(viewable.cameras), "color" in viewable.layers
        self._total = total
        gui.add_html(f"<style>{NARROW_WINDOW}</style>")
        self.status = gui.add_markdown("")
        self.frame = gui.add_slider("Frame", 0, max(total - 1, 1), 1, 0, disabled=total < 2)
        self.play = gui.add_button("Play", disabled=total < 2)
        self.speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1x")
        self.layer = gui.add_dropdown("Layer", [LAYER_NAMES[layer] for layer in viewable.layers])
        self.camera = gui.add_dropdown("Camera", (ENDOSCOPE, ORBIT))
        with gui.add_folder("Measure"):
            self.measure = gui.add_checkbox("Measure by clicking", False)
            self.quantity = gui.add_dropdown("Quantity", tuple(POINTS_OF), visible=trained)
            hint = "The table has every quantity of the points, in all frames."
            self.points = gui.add_button_group("Points", (CLEAR, TABLE), hint=hint)
            self.distance = gui.add_markdown("")
            series = (
                uplot.Series(label="frame"),
                uplot.Series(label="value", stroke="orange", width=2),
                *(uplot.Series(label=end, stroke="gray", width=1) for end in ("from", "to")),  # of 95 %
            )
            scales, empty = {"x": uplot.Scale(time=False)}, (np.arange(float(total)), *[np.zeros(total)] * 3)
            self.chart = gui.add_uplot(empty, series, scales=scales, height=CHART_HEIGHT, visible=False)
        with gui.add_folder("Save"):
            hint = "The video shows all frames from this view, or goes through the saved views."
            self.save_view = gui.add_button_group("View", (IMAGE, VIDEO), hint=hint)
            hint = "PLY: the Gaussians of this frame. Slicer: all frames, as .mrb. Mesh: it moves, .glb, for Blender."
            self.save_scene = gui.add_button_group("Model", (PLY, SLICER, MESH), visible=trained, hint=hint)
        with gui.add_folder("Scale", visible=viewable.can_scale):
            hint = "Measure a distance of this length. All lengths of the folder become mm."
            self.known_mm = gui.add_number("Known length, mm", 0.0, min=0.0, max=MAX_MM, hint=hint)
            self.save_scale = gui.add_button("Save scale")
            self.scaled = gui.add_markdown("")
        with gui.add_folder("Correct tool masks", visible=viewable.mask_edits is not None):
            width = viewable.cameras[0].width
            self.correct = gui.add_checkbox("Correct by painting", False)
            self.erase = gui.add_checkbox("Erase", False, hint="Or hold Shift.")
            self.radius = gui.add_slider("Brush radius, px", 1, max(width // 8, 2), 1, max(width // 50, 1))
            hint = "On a tool that the masks miss, or with Erase on tissue that is masked: done in all frames."
            self.find = gui.add_checkbox("Click finds the region", False, hint=hint)
            self.undo = gui.add_button("Undo")
            self.carry = gui.add_button("Carry to other frames", hint="Moves the correction along with the image.")
            self.save_masks = gui.add_button("Save masks")
            self.corrected = gui.add_markdown("")
        with gui.add_folder("Show", expand_by_default=False):
            self.tool = gui.add_checkbox("Tool overlay", False, visible=viewable.has_tool)
            self.smoke = gui.add_checkbox("Smoke", False, visible=viewable.has_smoke)
            self.tracks = gui.add_checkbox("Material tracks", False)
            hint = "Displacement and stretch are measured since this frame."
            self.since = gui.add_slider("Since frame", 0, max(total - 1, 1), 1, 0, visible=trained, hint=hint)
            moves = bool(np.ptp([camera.world_to_camera for camera in viewable.cameras], axis=0).any())
            hint = "The view of Orbit keeps its place beside the endoscope."
            self.riding = gui.add_checkbox("Move with the endoscope", True, visible=moves, hint=hint)
            self.rendered_by = gui.add_dropdown("Rendered by", (SERVER, BROWSER), visible=trained)
            self.rendered_as = gui.add_dropdown("Rendered as", (SPLATS, POINTS), visible=trained)
            self.clip_end = float(np.ceil(CLIP_MARGIN * viewable.span[1])) or 1.0
            step, unit = 10.0 ** np.floor(np.log10(self.clip_end / 100)), length_unit(viewable.relative)
            whole = 0.0, self.clip_end
            self.clip = gui.add_multi_slider(f"Depth range, {unit}", *whole, float(step), whole)
        with gui.add_folder("Track", expand_by_default=False):
            self.follow = gui.add_checkbox("Track by clicking", False, hint="Faded: hidden or uncertain.")
            self.clear_tracks = gui.add_button("Clear tracks")
        with gui.add_folder("Views of the video", expand_by_default=False):
            self.keep = gui.add_button("Save this view", hint="The video interpolates between saved views, in order.")
            self.forget = gui.add_button("Delete saved views")
        self._controls = {control_id(h): (name, h) for name, h in vars(self).items() if hasattr(h, "value")}

    def accepts(self, uuid: str, value: Any) -> bool:
        """Whether the control with this id can have this value; False if there is no such control."""
        name, control = self._controls.get(uuid, ("", None))
        if control is None:
            return False
        if name == "clip":
            return are_numbers(value, 2, self.clip_end) and min(value) >= 0
        if hasattr(control, "max"):
            return are_numbers([value], 1, control.max) and value >= control.min
        if hasattr(control, "options"):
            return isinstance(value, str) and value in control.options
        return isinstance(value, bool)

    def set_length(self, total: int, settings: ViewSettings) -> None:
        """Offer this number of frames, and show the two of `settings`."""
        self._total = total
        for slider, value in ((self.frame, settings.frame), (self.since, settings.since)):
            slider.value, slider.max = value, max(total - 1, 1)
        self.frame.disabled = self.play.disabled = total < 2

    @property
    def rate(self) -> float:
        """Playback speed relative to the recording."""
        return float(self.speed.value.removesuffix("x"))

    def show_curve(self, values: NDArray, ranges: NDArray) -> None:
        """Show a quantity over the frames (T,) between the ends of its ranges, half of which are given; or hide the
        chart if it is known in fewer than two.
        """
        self.chart.visible = bool(np.isfinite(values).sum() > 1)
        if self.chart.visible:
            self.chart.data = np.arange(float(len(values))), values, np.maximum(values - ranges, 0), values + ranges

    def chosen(self, settings: ViewSettings) -> ViewSettings:
        """`settings` updated with the current values of the controls under Show."""
        layers = {name: layer for layer, name in LAYER_NAMES.items()}
        near, far = self.clip.value
        return replace(
            settings,
            layer=layers[self.layer.value],
            endoscope=self.camera.value == ENDOSCOPE,
            riding=self.riding.value,
            in_browser=self.rendered_by.value == BROWSER,
            points=self.rendered_as.value == POINTS,
            tool=self.tool.value,
            smoke=self.smoke.value,
            correcting=self.correct.value,
            since=min(int(self.since.value), self._total - 1),
            tracks=self.tracks.value,
            near=near,
            far=far if far < self.clip_end else float("inf"),
        )


def plain(text: str) -> str:
    """Escape text for Markdown: the name of a folder must not become an image, a link or a script."""
    shown = "".join(letter if letter.isprintable() else " " for letter in text)
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", shown)


def status(viewable: Viewable, settings: ViewSettings, num_kept: int) -> str:
    """Description of the current view, in a few lines."""
    lines = [f"**{plain(viewable.title)}**", f"frame {settings.frame} of {len(viewable.cameras)}"]
    if legend := viewable.legend(settings):
        lines.append(legend)
    if settings.in_browser and not viewable.renders_in_browser(settings):
        lines.append("This layer is rendered by the server.")
    if not settings.endoscope and settings.layer in ("frame", "difference") and "color" in viewable.layers:
        lines.append("Input frames are available in the endoscope view only; showing color.")
    if settings.correcting and not settings.endoscope:
        lines.append("Tool masks are corrected in the endoscope view.")
    if viewable.relative:
        lines.append("Depth is **relative**: lengths are not mm.")
    if viewable.scale_text:
        lines.append(f"Scale: {plain(viewable.scale_text)}.")
    if num_kept:
        lines.append(f"{num_kept} saved views")
    return "  \n".join(lines)
