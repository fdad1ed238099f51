"""Viewer content: a trained scene."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import render
from ..core.geometry import back_project, expected_depth, length_unit, project, quaternion_to_matrix
from ..core.types import Camera, RenderOutput, Splats
from ..data import FrameSequence
from ..model.carry import CarriedPoints, carry, centers_then
from ..model.colors import FEW_ITERATIONS, one_color
from ..model.gaussians import SH_C0, with_colors
from ..model.measures import SurfaceMotion, distance
from ..model.playback import Playback
from ..model.scene import Scene
from ..model.surface import Support, Surface, project_visible, shown_pixels
from ..visualization.image_tools import gray, to_u8
from ..visualization.measures import displacement_span, stretch_span, value_colors
from ..visualization.rendered_views import depth_span
from . import layers
from .viewable import Cloud, Layer, ViewSettings
from .viewport import shrunk_camera

VALUE_LAYERS = ("displacement", "stretch", "prior", "support")
"""Layers that are one value per Gaussian."""
BROWSER_LAYERS = ("color", *VALUE_LAYERS)
"""Layers that are one color per Gaussian."""
DOT_PX = 0.6
"""Standard deviation of a dot in the endoscope image, px."""
DOT_OPACITY = 0.98
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
        self.cameras = scene.cameras
        self.frames_per_second = scene.frames_per_second
        self.relative = scene.lengths_are_relative
        self.has_tool = sequence is not None
        self.mask_edits = None
        self._playback = Playback(scene)
        self._motion: SurfaceMotion | None = None
        self._measured = lru_cache(MAX_MEASURED)(self._measure)
        self._value_span = lru_cache(MAX_MEASURED)(self._span_of)
        self._rasterize = render.load(scene.backend)
        self._seen = lru_cache(SEEN_FRAMES)(self._surface_and_mask)
        self._plain = lru_cache(PLAIN_FRAMES)(self._one_color)

    @cached_property
    def span(self) -> tuple[float, float]:
        """Depth range of nearly all of the first frame, mm."""
        return depth_span(self.scene)

    def picture(self, settings: ViewSettings, camera: Camera) -> NDArray[np.uint8]:
        """From another camera the input frames do not fit; shows rendered color instead."""
        kind = settings.layer if settings.endoscope or settings.layer not in ("frame", "difference") else "color"
        picture = self._layer(kind, settings, camera)
        if settings.tool and settings.endoscope and self.sequence is not None:
            frame = self.sequence.frame(settings.frame)
            original, mask = layers.fitted(frame.rgb_u8, camera), layers.fitted(frame.tissue_mask, camera)
            picture = layers.with_tool(picture, original, mask)
        return picture

    def _layer(self, kind: Layer, settings: ViewSettings, camera: Camera) -> NDArray[np.uint8]:
        if kind == "frame":
            return layers.fitted(self.sequence.frame(settings.frame).rgb_u8, camera)
        out = self._draw(settings, camera, self._values(settings) if kind in VALUE_LAYERS else None)
        alpha = out.alpha.cpu().numpy()
        if kind == "depth":
            return layers.depth_picture(expected_depth(out.depth.cpu().numpy(), alpha), self.span)
        if kind == "alpha":
            return gray(alpha)
        if kind in VALUE_LAYERS:
            value, known, _ = np.moveaxis(out.color.cpu().numpy(), -1, 0)
            return layers.value_picture(value, known)
        color = to_u8(out.color.cpu().numpy())
        if kind == "difference":
            return layers.difference_picture(color, layers.fitted(self.sequence.frame(settings.frame).rgb_u8, camera))
        return color

    def surface(self, settings: ViewSettings, camera: Camera) -> NDArray[np.float32]:
        out = self._draw(settings, camera)
        return expected_depth(out.depth.cpu().numpy(), out.alpha.cpu().numpy())

    @torch.no_grad()
    def _draw(self, settings: ViewSettings, camera: Camera, values: Tensor | None = None) -> RenderOutput:
        """Render the selected Gaussians; `values` (N,) in [0, 1] become red, and green 1 where they are known."""
        splats, behind = self._splats(settings), self.scene.background
        if values is not None:
            splats, behind = with_colors(splats, _value_colors(values)), (0.0, 0.0, 0.0)
        clipped = _clipped(splats, camera, settings.near, settings.far)
        return self._rasterize(clipped, camera, background=splats.means.new_tensor(behind))

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
        time = settings.frame / len(self.cameras)
        if settings.layer == "prior":
            return torch.cat([shown.window.scene.prior_score for shown in self.scene.shown_at(time)]).clamp(0, 1)
        if settings.layer == "support":
            return self._numbers(self._support.share(time))
        low, high = self._value_span(settings.layer, settings.since)
        values = self._measured(settings.layer, settings.since, settings.frame)
        return ((self._numbers(values) - low) / (high - low)).clamp(0, 1)

    def _numbers(self, values: NDArray) -> Tensor:
        return torch.from_numpy(values).to(self.scene.device, torch.float32)

    @cached_property
    def _support(self) -> Support:
        return Support(self.scene, self.sequence.training_part)

    def _measure(self, layer: Layer, since: int, frame: int) -> NDArray[np.float32]:
        """(N,) displacement of each center since a frame, mm, or stretch of the surface there; NaN where unknown."""
        num = len(self.cameras)
        before = centers_then(self.scene, frame / num, since / num)
        if layer == "displacement":
            return distance(self._playback.splats(frame).means.cpu().numpy(), before).astype(np.float32)
        return self._surface_motion(since).stretch(before, [frame])[0].astype(np.float32)

    def _surface_motion(self, since: int) -> SurfaceMotion:
        """The surface in frame `since`, rendered once until another frame is asked for."""
        if self._motion is None or self._motion.since != since:
            self._motion = SurfaceMotion(self.scene, since)
        return self._motion

    def _span_of(self, layer: Layer, since: int) -> tuple[float, float]:
        """Ends of the color scale of a layer, the same for all frames."""
        frames = np.linspace(0, len(self.cameras) - 1, min(MOTION_SAMPLES, len(self.cameras))).astype(int).tolist()
        if layer == "displacement":
            return max(displacement_span(self._measured(layer, since, frame)) for frame in frames)
        motion = self._surface_motion(since)
        return max((stretch_span(each) for each in motion.stretch(motion.samples, frames)), key=lambda ends: ends[1])

    def renders_in_browser(self, settings: ViewSettings) -> bool:
        """Layers that are not a color per Gaussian are rendered on the server."""
        return settings.in_browser and settings.layer in BROWSER_LAYERS

    @torch.no_grad()
    def cloud(self, settings: ViewSettings) -> Cloud:
        """One color each, without what depends on the view."""
        in_color = settings.layer == "color"
        drawn = self._plain(settings.frame) if in_color and not settings.points else self._splats(settings)
        within = (self.cameras[settings.frame], settings.near, settings.far)
        splats = _clipped(drawn, *within)
        if in_color:
            colors = to_u8((splats.sh[:, 0] * SH_C0 + 0.5).cpu().numpy())
        else:
            colors = value_colors(_rows(self._values(settings), drawn, *within).cpu().numpy(), (0, 1))
        points = splats.means.cpu().numpy()
        if settings.points:
            return Cloud(points, colors, None, None, 3 * self._dot_mm)
        return Cloud(points, colors, _covariances(splats), splats.opacities.cpu().numpy(), 0.0)

    @torch.enable_grad()
    def _one_color(self, frame: int) -> Splats:
        return one_color(self._playback.splats(frame), self.cameras[frame], FEW_ITERATIONS, self.scene.backend)

    def stretch(self, points: NDArray, since: int) -> NDArray[np.float64]:
        return self._surface_motion(since).stretch(points, list(range(len(self.cameras))))

    def follow(self, points: NDArray, frames: list[int]) -> CarriedPoints:
        times = [i / len(self.cameras) for i in range(len(self.cameras))]
        return carry(self.scene, np.asarray(points), np.array(frames), times)

    def shows(self, points: NDArray, frame: int) -> NDArray[np.bool_]:
        """By a small rendered depth and the tool mask."""
        surface, mask = self._seen(frame)
        shown = project_visible(points, surface)[1]
        return shown if mask is None else shown & shown_pixels(project(points, self.cameras[frame])[0], mask)

    def _surface_and_mask(self, frame: int) -> tuple[Surface, NDArray[np.bool_] | None]:
        camera = self.cameras[frame]
        small = shrunk_camera(camera, max(camera.width // SEEN_WIDTH, 1))
        depth = self.surface(ViewSettings(frame=frame), small)
        surface = Surface(depth, np.zeros((*depth.shape, 3), np.float32), small)
        return surface, None if self.sequence is None else layers.fitted(self.sequence.frame(frame).tissue_mask, camera)

    def tracks(self) -> CarriedPoints:
        """A grid on the surface of the first frame, off the tool."""
        camera, settings = self.cameras[0], ViewSettings()
        depth = self.surface(settings, camera)
        if self.sequence is not None:
            depth = depth * self.sequence.frame(0).tissue_mask
        step = max(camera.width // TRACK_COLUMNS, 1)
        y, x = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
        y, x = (values[depth[y, x] > 0] for values in (y, x))
        points = back_project(np.stack([x, y], -1) + 0.5, depth[y, x].astype(np.float64), camera)
        if not len(points):
            return CarriedPoints(np.zeros((len(self.cameras), 0, 3)), np.zeros((len(self.cameras), 0)))
        return self.follow(points, [0] * len(points))

    def legend(self, settings: ViewSettings) -> str:
        unit = length_unit(self.relative)
        if settings.layer in ("displacement", "stretch"):
            low, high = self._value_span(settings.layer, settings.since)
            if settings.layer == "displacement":
                return f"moved since frame {settings.since}: blue 0 to red {high:.1f} {unit}"
            scale = f"blue {low:.2f} (shorter), green 1 (unchanged), red {high:.2f} (longer)"
            return f"largest stretch since frame {settings.since}: {scale}; black: not seen then"
        return {
            "depth": f"blue {self.span[0]:.1f} to red {self.span[1]:.1f} {unit}",
            "alpha": "black 0 to white 1: coverage by the Gaussians",
            "prior": "texture-prior score of the Gaussians: blue 0 to red 1",
            "support": "share of the frames that show this tissue: blue none, a guess, to red all",
            "difference": f"rendered minus input: blue 0 to red {layers.LARGEST_DIFFERENCE:.0%}",
        }.get(settings.layer, "")


def _value_colors(values: Tensor) -> Tensor:
    """(N, 3) colors that render (N,) `values` as red and 1 as green; both 0 where a value is NaN."""
    known = torch.isfinite(values)
    return torch.stack([values.nan_to_num(), known.to(values), torch.zeros_like(values)], -1)


def _clipped(splats: Splats, camera: Camera, near: float, far: float) -> Splats:
    """The Gaussians whose centers lie between two depths of `camera`, mm; all of them without limits."""
    return Splats(**{name: _rows(value, splats, camera, near, far) for name, value in splats.tensors.items()})


def _rows(values: Tensor, splats: Splats, camera: Camera, near: float, far: float) -> Tensor:
    """The rows of `values` (N, ...) of these Gaussians."""
    if near <= 0 and far == float("inf"):
        return values
    pose = torch.from_numpy(camera.world_to_camera[2]).to(splats.means)
    z = splats.means @ pose[:3] + pose[3]
    return values[(z >= near) & (z <= far)]


def _covariances(splats: Splats) -> NDArray[np.float32]:
    """(N, 3, 3) second moments, mm^2."""
    axes = quaternion_to_matrix(splats.quats.cpu().numpy()) * splats.scales.cpu().numpy()[:, None, :]
    return (axes @ np.swapaxes(axes, 1, 2)).astype(np.float32)
