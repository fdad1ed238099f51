"""Viewer content: a trained scene. T frames, N Gaussians."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import render
from ..core.geometry import back_project, expected_depth, length_unit, project, quaternion_to_matrix
from ..core.types import Camera, RenderOutput, Splats, frame_times, to_uint8
from ..data import FrameSequence
from ..model.carry import carry, centers_then
from ..model.colors import FEW_ITERATIONS, one_color
from ..model.gaussians import SH_C0, with_colors
from ..model.measures import SurfaceMotion, distance
from ..model.photometric import behind_smoke
from ..model.playback import Playback
from ..model.scene import Scene
from ..model.surface import Support, Surface, project_visible, shown_pixels
from ..model.uncertainty import point_errors
from ..visualization.image_tools import SOLID_ALPHA, colorize, gray
from ..visualization.measures import displacement_span, stretch_span, value_colors
from ..visualization.rendered_views import depth_span
from . import layers
from .viewable import Cloud, FollowedPoints, Layer, ViewSettings
from .viewport import shrunk_camera

VALUE_LAYERS = ("displacement", "stretch", "prior", "support")
"""Layers that are one value per Gaussian. Browsers can render them and color."""
MAX_DIFFERENCE = 0.25
"""Mean absolute color difference that is shown in red."""
DOT_PX, DOT_OPACITY = 0.6, 0.98
"""Standard deviation of a dot in the endoscope image."""
TRACK_COLUMNS = 16
"""Number of material points along a row of the image."""
SEEN_WIDTH, SEEN_FRAMES = 160, 200
"""Least width of the depth that tells which points a frame shows, px, and how many frames of it are cached."""
PLAIN_FRAMES = 64
"""Number of frames whose Gaussians of one color each are cached for the browser."""
MAX_MEASURED = 256
"""Largest number of frames whose displacement or stretch is kept."""
MOTION_SAMPLES = 8
"""Number of times used for the color scales of displacement and stretch."""


class ViewableScene:
    """A scene and, if available, the sequence it was trained on."""

    def __init__(self, scene: Scene, title: str, sequence: FrameSequence | None = None) -> None:
        """Prepare the content; render nothing yet.

        Args:
            sequence: with as many frames as the scene has cameras; None disables input frames, difference and tool.
        """
        self.scene, self.title, self.sequence = scene, title, sequence
        self.layers: tuple[Layer, ...] = ("color", "depth", "alpha", "displacement", "stretch", "prior")
        if sequence is not None:
            self.layers += ("support", "frame", "difference")
        self.cameras, self.frames_per_second = scene.cameras, scene.frames_per_second
        self.relative = scene.lengths_are_relative
        self.can_scale, self.save_scale, self.scale_text = False, None, ""  # a scale must be there before training
        self.has_tool, self.mask_edits = sequence is not None, None
        self.has_smoke = any(window.scene.smoke is not None for window in scene.windows)
        self._playback, self._rasterize = Playback(scene), render.load(scene.backend)
        self._measured = lru_cache(MAX_MEASURED)(self._measure)
        self._value_span = lru_cache(MAX_MEASURED)(self._span_of)
        self._surface_motion = lru_cache(1)(lambda since: SurfaceMotion(scene, since))
        self._seen = lru_cache(SEEN_FRAMES)(self._surface_and_mask)
        self._plain = lru_cache(PLAIN_FRAMES)(self._one_color)

    @cached_property
    def span(self) -> tuple[float, float]:
        """Depth range of nearly all of the first frame, mm."""
        return depth_span(self.scene)

    def picture(self, settings: ViewSettings, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) image of the selected layer and frame; color where the input does not fit another camera."""
        kind = settings.layer
        if self.sequence is None or not settings.endoscope:
            return self._rendered("color" if kind in ("frame", "difference") else kind, settings, camera)
        frame = self.sequence.frame(settings.frame)
        original = layers.fitted(frame.rgb_u8, camera)
        if kind == "frame":
            picture = original
        elif kind == "difference":
            shown = self._rendered("color", replace(settings, smoke=True), camera)
            difference = cv2.absdiff(shown, original).mean(-1) / 255
            picture = colorize(difference, 0, MAX_DIFFERENCE)
        else:
            picture = self._rendered(kind, settings, camera)
        tool = ~layers.fitted(frame.tissue_mask, camera)
        return layers.with_tool(picture, original, tool) if settings.tool else picture

    def _rendered(self, kind: Layer, settings: ViewSettings, camera: Camera) -> NDArray[np.uint8]:
        out = self._draw(settings, camera, self._values(settings) if kind in VALUE_LAYERS else None)
        color, alpha = out.color.cpu().numpy(), out.alpha.cpu().numpy()
        if kind == "depth":
            depth = expected_depth(out.depth.cpu().numpy(), alpha)
            return colorize(depth, *self.span, depth > 0)
        if kind == "alpha":
            return gray(alpha)
        if kind in VALUE_LAYERS:  # black where little is known: no surface, or nothing known of it
            value, known, _ = np.moveaxis(color, -1, 0)
            return colorize(value / np.maximum(known, 1e-6), 0, 1, known > SOLID_ALPHA)
        if settings.smoke and settings.endoscope:
            view = behind_smoke(out.view, self.scene.smoke_at(self.scene.frame_time(settings.frame)))
            color = view.color.cpu().numpy()
        return to_uint8(color)

    def surface(self, settings: ViewSettings, camera: Camera) -> NDArray[np.float32]:
        """(H, W) z of the visible surface, mm; 0 where there is none."""
        out = self._draw(settings, camera)
        return expected_depth(out.depth.cpu().numpy(), out.alpha.cpu().numpy())

    @torch.no_grad()
    def _draw(self, settings: ViewSettings, camera: Camera, values: Tensor | None = None) -> RenderOutput:
        """Render the selected Gaussians; `values` (N,) in [0, 1] become red, and green 1 where they are not NaN."""
        splats, behind = self._splats(settings), self.scene.background
        if values is not None:
            known = torch.isfinite(values)
            colors = torch.stack([values.nan_to_num(), known.to(values), torch.zeros_like(values)], -1)
            splats, behind = with_colors(splats, colors), (0.0, 0.0, 0.0)
        drawn = _taken(splats, _rows(splats, settings, camera))
        return self._rasterize(drawn, camera, background=splats.means.new_tensor(behind))

    def _splats(self, settings: ViewSettings) -> Splats:
        splats = self._playback.splats(settings.frame)
        if not settings.points:
            return splats
        scales = torch.full_like(splats.scales, self._dot_mm)
        return replace(splats, scales=scales, opacities=torch.full_like(splats.opacities, DOT_OPACITY))

    @property
    def _dot_mm(self) -> float:
        return DOT_PX * sum(self.span) / 2 / self.cameras[0].fy

    def _values(self, settings: ViewSettings) -> Tensor:
        """(N,) value of the layer for each Gaussian, as a share of the color scale, in [0, 1]; NaN where unknown."""
        time, low, high = self.scene.frame_time(settings.frame), 0.0, 1.0
        if settings.layer == "prior":
            return torch.cat([shown.window.scene.prior_score for shown in self.scene.shown_at(time)]).clamp(0, 1)
        if settings.layer == "support":
            values = np.where(self._support.depth_is_guess(time), 0, self._support.share(time))
        else:
            low, high = self._value_span(settings.layer, settings.since)
            values = self._measured(settings.layer, settings.since, settings.frame)
        return ((torch.from_numpy(values).to(self.scene.device, torch.float32) - low) / (high - low)).clamp(0, 1)

    @cached_property
    def _support(self) -> Support:
        assert self.sequence is not None, "the layer is offered with a sequence only"
        return Support(self.scene, self.sequence.training_part)

    def _measure(self, layer: Layer, since: int, frame: int) -> NDArray[np.float32]:
        """(N,) displacement of each center since a frame, mm, or stretch of the surface there; NaN where unknown."""
        num = len(self.cameras)
        before = centers_then(self.scene, frame / num, since / num)
        if layer == "displacement":
            return distance(self._playback.splats(frame).means.cpu().numpy(), before).astype(np.float32)
        return self._surface_motion(since).stretch(before, [frame])[0].astype(np.float32)

    def _span_of(self, layer: Layer, since: int) -> tuple[float, float]:
        """Ends of the color scale of a layer, the same for all frames."""
        frames = np.linspace(0, len(self.cameras) - 1, min(MOTION_SAMPLES, len(self.cameras))).astype(int).tolist()
        if layer == "displacement":
            return max(displacement_span(self._measured(layer, since, frame)) for frame in frames)
        motion = self._surface_motion(since)
        return max((stretch_span(each) for each in motion.stretch(motion.samples, frames)), key=lambda ends: ends[1])

    def renders_in_browser(self, settings: ViewSettings) -> bool:
        """Whether the browser renders this view itself, from a `cloud`."""
        return settings.in_browser and settings.layer in ("color", *VALUE_LAYERS)

    @torch.no_grad()
    def cloud(self, settings: ViewSettings) -> Cloud:
        """The content for the browser to render: one color each, without what depends on the view."""
        camera, in_color = self.cameras[settings.frame], settings.layer == "color"
        splats = self._plain(settings.frame) if in_color and not settings.points else self._splats(settings)
        rows = _rows(splats, settings, camera)
        splats = _taken(splats, rows)
        if in_color:
            colors = to_uint8((splats.sh[:, 0] * SH_C0 + 0.5).cpu().numpy())
        else:
            colors = value_colors(self._values(settings)[rows].cpu().numpy(), (0, 1))
        points = splats.means.cpu().numpy()
        if settings.points:
            return Cloud(points, colors, 3 * self._dot_mm)
        axes = quaternion_to_matrix(splats.quats.cpu().numpy()) * splats.scales.cpu().numpy()[:, None, :]
        covariances = (axes @ np.swapaxes(axes, 1, 2)).astype(np.float32)
        return Cloud(points, colors, 0.0, covariances, splats.opacities.cpu().numpy())

    @torch.enable_grad()
    def _one_color(self, frame: int) -> Splats:
        return one_color(self._playback.splats(frame), self.cameras[frame], FEW_ITERATIONS, self.scene.backend)

    def stretch(self, points: NDArray, since: int) -> NDArray[np.float64]:
        """(T, K) largest principal stretch since a frame, around points (K, 3) of that frame; NaN where unknown."""
        return self._surface_motion(since).stretch(points, list(range(len(self.cameras))))

    def follow(self, points: NDArray, frames: list[int]) -> FollowedPoints:
        """Points (K, 3), each picked in its frame of `frames`, in every frame; NaN where unknown."""
        times, own = frame_times(len(self.cameras)), np.array(frames, np.intp)
        carried = carry(self.scene, np.asarray(points), own, times)
        return FollowedPoints(carried.positions, point_errors(self.scene, carried, own, range(len(times))))

    def shows(self, points: NDArray, frame: int) -> NDArray[np.bool_]:
        """(P,) whether the endoscope's image of a frame shows points (P, 3): neither tissue nor tool hides them."""
        surface, mask = self._seen(frame)
        shown = project_visible(points, surface)[1]
        return shown if mask is None else shown & shown_pixels(project(points, self.cameras[frame])[0], mask)

    def _surface_and_mask(self, frame: int) -> tuple[Surface, NDArray[np.bool_] | None]:
        camera = self.cameras[frame]
        small = shrunk_camera(camera, max(camera.width // SEEN_WIDTH, 1))
        depth = self.surface(ViewSettings(frame=frame), small)
        surface = Surface(depth, np.zeros((*depth.shape, 3), np.float32), small)
        return surface, None if self.sequence is None else layers.fitted(self.sequence.frame(frame).tissue_mask, camera)

    def tracks(self) -> FollowedPoints:
        """Tracks of material points: a grid on the surface of the first frame, off the tool; there may be none."""
        camera = self.cameras[0]
        depth = self.surface(ViewSettings(), camera)
        if self.sequence is not None:
            depth = depth * self.sequence.frame(0).tissue_mask
        step = max(camera.width // TRACK_COLUMNS, 1)
        y, x = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
        y, x = (values[depth[y, x] > 0] for values in (y, x))
        points = back_project(np.stack([x, y], -1) + 0.5, depth[y, x].astype(np.float64), camera)
        return self.follow(points, [0] * len(points))

    def legend(self, settings: ViewSettings) -> str:
        """Meaning of the colors in one line; empty for plain color."""
        unit, since = length_unit(self.relative), settings.since
        measured = settings.layer in ("displacement", "stretch")
        low, high = self._value_span(settings.layer, since) if measured else self.span
        stretch = f"blue {low:.2f} (shorter), green 1 (unchanged), red {high:.2f} (longer)"
        return {
            "depth": f"blue {low:.1f} to red {high:.1f} {unit}",
            "alpha": "black 0 to white 1: coverage by the Gaussians",
            "displacement": f"moved since frame {since}: blue 0 to red {high:.1f} {unit}",
            "stretch": f"largest stretch since frame {since}: {stretch}; black: not seen then",
            "prior": "texture-prior score of the Gaussians: blue 0 to red 1",
            "support": "share of the frames that show this tissue: blue none, or its depth is a guess, to red all",
            "difference": f"rendered minus input: blue 0 to red {MAX_DIFFERENCE:.0%}",
        }.get(settings.layer, "")


def _rows(splats: Splats, settings: ViewSettings, camera: Camera) -> Tensor | slice:
    """The Gaussians whose centers lie between the two depths of the settings; all of them without limits."""
    if settings.near <= 0 and settings.far == float("inf"):
        return slice(None)
    pose = torch.from_numpy(camera.world_to_camera[2]).to(splats.means)
    z = splats.means @ pose[:3] + pose[3]
    return (z >= settings.near) & (z <= settings.far)


def _taken(splats: Splats, rows: Tensor | slice) -> Splats:
    return Splats(**{name: value[rows] for name, value in splats.tensors.items()})
