"""Viewer content: a raw sequence before training, with frames, tools and measured depth as points."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import back_project, camera_to_world, length_unit, pixel_centers
from ..core.types import Camera
from ..data import FrameSequence
from ..data.edit import write_scale
from ..data.scale import scale_between
from ..priors import joint_texture_prior
from ..visualization.image_tools import colorize
from . import layers
from .mask_editor import MaskEdits
from .viewable import Cloud, FollowedPoints, Layer, ViewSettings
from .viewable_scene import ViewableScene

MAX_POINTS = 100_000
"""Largest number of points sent to a browser per frame; larger images are subsampled."""
DEFAULT_FRAMES_PER_SECOND = 25.0


class ViewableSequence:
    """Frames of a sequence folder; its methods are those of `ViewableScene`."""

    layers: tuple[Layer, ...] = ("frame", "depth", "prior")
    has_tool, has_smoke = True, False
    scene = None
    """There is none before training."""

    def __init__(self, sequence: FrameSequence) -> None:
        self.sequence, self.title = sequence, str(sequence.path)
        self.cameras = tuple(sequence.camera(i) for i in range(len(sequence)))
        self.frames_per_second = sequence.frames_per_second or DEFAULT_FRAMES_PER_SECOND
        self.relative = sequence.depth_is_relative
        self.scale_text = "" if sequence.scale is None else sequence.scale.text
        self.can_scale = sequence.depth_is_guessed and (sequence.path / "sequence.json").is_file()
        self._masks = MaskEdits(sequence)
        self.mask_edits = self._masks if sequence.mask_files else None

    @cached_property
    def span(self) -> tuple[float, float]:
        """Depth range of nearly all of the first frame with depth, mm."""
        for i in range(len(self.sequence)):
            frame = self.sequence.frame(i)
            if frame.depth_valid.any():
                low, high = np.percentile(frame.depth[frame.depth_valid], (2, 98))
                return float(low), float(high)
        return 0.0, 1.0

    def picture(self, settings: ViewSettings, camera: Camera) -> NDArray[np.uint8]:
        """From another camera, the measured points."""
        if not settings.endoscope:
            return self._dots(settings, camera)[0]
        frame, tool = self.sequence.frame(settings.frame), self._masks.tool(settings.frame)
        original = picture = layers.fitted(frame.rgb_u8, camera)
        if settings.layer == "depth":
            depth = self.surface(settings, camera)
            picture = colorize(depth, *self.span, depth > 0)
        elif settings.layer == "prior":
            picture = colorize(layers.fitted(joint_texture_prior(frame.rgb, ~tool), camera), 0, 1)
        elif settings.near > 0 or settings.far < float("inf"):
            picture = picture * (self.surface(settings, camera) > 0)[..., None]
        tool = layers.fitted(tool, camera)
        if settings.correcting:
            return layers.with_mask(picture, tool)
        return layers.with_tool(picture, original, tool) if settings.tool else picture

    def surface(self, settings: ViewSettings, camera: Camera) -> NDArray[np.float32]:
        """The measured depth."""
        if not settings.endoscope:
            return self._dots(settings, camera)[1]
        frame = self.sequence.frame(settings.frame)
        depth = frame.depth * (frame.depth_valid & (frame.depth >= settings.near) & (frame.depth <= settings.far))
        return layers.fitted(depth.astype(np.float32), camera)

    def save_scale(self, points: NDArray[np.float64], frame: int, mm: float) -> str:
        """Bring the folder to mm by two points (2, 3) of a frame that are so far apart; what was done, in a line.

        The viewer goes on in the units that it has read.

        Raises:
            InputError: no length, or the folder cannot be written.
        """
        old = self.sequence.scale
        scale = scale_between(points, self.cameras[frame], mm, frame, old, "Known length, mm")
        write_scale(self.sequence.path, scale)
        ratio = scale.factor / (old.factor if old else 1.0)
        shown = f"1 {length_unit(self.relative)} shown here is {ratio:.4g} mm"
        return f"Saved: {scale.text}. {shown}; open the folder again to see mm."

    def _dots(self, settings: ViewSettings, camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        cloud = self.cloud(settings)
        return layers.render_points(cloud.points, cloud.colors, cloud.size, camera)

    def renders_in_browser(self, settings: ViewSettings) -> bool:
        """From another camera there are only the points."""
        return not settings.endoscope

    def cloud(self, settings: ViewSettings) -> Cloud:
        """Measured points; those of the tool only with the tool overlay."""
        camera = self.cameras[settings.frame]
        settings = replace(settings, endoscope=True, correcting=False)
        depth = self.surface(settings, camera)
        seen = (depth > 0) & (~self._masks.tool(settings.frame) | settings.tool)
        step = int(np.ceil(np.sqrt(max(seen.sum() / MAX_POINTS, 1))))
        rows, columns = (indices * step for indices in np.nonzero(seen[::step, ::step]))
        pixels = pixel_centers(camera.width, camera.height)[rows, columns]
        points = back_project(pixels.astype(np.float64), depth[rows, columns].astype(np.float64), camera)
        colors = self.picture(settings, camera)[rows, columns]
        return Cloud(points.astype(np.float32), colors, step * sum(self.span) / 2 / camera.fy)

    def stretch(self, points: NDArray, _since: int) -> NDArray[np.float64]:
        """Unknown before training."""
        return np.full((len(self.cameras), len(points)), np.nan)

    def follow(self, points: NDArray, frames: list[int]) -> FollowedPoints:
        """A point is known only in the frame in which it was picked."""
        paths = np.full((len(self.cameras), *np.shape(points)), np.nan)
        paths[frames, range(len(frames))] = points
        return FollowedPoints(paths)

    def shows(self, points: NDArray, _frame: int) -> NDArray[np.bool_]:
        """Where points are known, they are seen."""
        return np.isfinite(points.sum(-1))

    def tracks(self) -> FollowedPoints:
        """The tracks of the ground truth, if there are any."""
        tracks = self.sequence.truth.tracks if self.sequence.truth else None
        if tracks is None or not tracks.paired:
            return FollowedPoints(np.zeros((len(self.cameras), 0, 3)))
        poses = camera_to_world(self.cameras)
        world = np.einsum("tij,tpj->tpi", poses[:, :3, :3], tracks.points) + poses[:, None, :3, 3]
        return FollowedPoints(np.where(tracks.visible[..., None], world, np.nan))

    def legend(self, settings: ViewSettings) -> str:
        """Meaning of the colors in one line; empty for plain color."""
        depth = "blue {:.1f} to red {:.1f} {}".format(*self.span, length_unit(self.relative))
        return {"depth": depth, "prior": "joint texture prior: blue 0 to red 1"}.get(settings.layer, "")


Viewable = ViewableScene | ViewableSequence
