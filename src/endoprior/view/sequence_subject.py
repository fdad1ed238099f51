"""A raw sequence as the viewer sees it: frames, tools, and its measured depth as points, before anything is trained."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..core.geometry import back_project, pixel_centers
from ..core.types import Camera
from ..data import FrameSequence
from ..priors import joint_texture_prior
from . import layers
from .dots import draw_dots
from .session import Layer, Look
from .subject import Cloud

MOST_POINTS = 100_000
"""Points sent to a browser per frame; larger pictures are thinned."""
DEFAULT_FRAMES_PER_SECOND = 25.0


class SequenceSubject:
    """Frames of a folder."""

    layers: tuple[Layer, ...] = ("frame", "depth", "prior")
    has_tool = True

    def __init__(self, sequence: FrameSequence) -> None:
        self.sequence = sequence
        self.title = str(sequence.path)
        self.cameras = tuple(sequence.camera(i) for i in range(len(sequence)))
        self.frames_per_second = sequence.frames_per_second or DEFAULT_FRAMES_PER_SECOND
        self.relative = sequence.depth_is_relative

    @cached_property
    def span(self) -> tuple[float, float]:
        """Depths, mm, between which nearly all of the first frame with depth lies."""
        for i in range(len(self.sequence)):
            frame = self.sequence.frame(i)
            if frame.depth_valid.any():
                low, high = np.percentile(frame.depth[frame.depth_valid], (2, 98))
                return float(low), float(high)
        return 0.0, 1.0

    def picture(self, look: Look, camera: Camera) -> NDArray[np.uint8]:
        """See `Subject.picture`: off the endoscope's place, the measured points."""
        if not look.endoscope:
            return self._dots(look, camera)[0]
        frame = self.sequence.frame(look.frame)
        if look.layer == "depth":
            picture = layers.depth_picture(self.surface(look, camera), self.span)
        elif look.layer == "prior":
            picture = layers.colorize(self._prior(look.frame, camera), 0, 1)
        else:
            picture = layers.fitted(frame.rgb_u8, camera)
            if look.near > 0 or look.far < float("inf"):
                picture = picture * (self.surface(look, camera) > 0)[..., None]
        if not look.tool:
            return picture
        mask = layers.fitted(frame.tissue_mask, camera)
        return layers.with_tool(picture, layers.fitted(frame.rgb_u8, camera), mask)

    def _dots(self, look: Look, camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        cloud = self.cloud(look)
        return draw_dots(cloud.points, cloud.colors, cloud.size, camera)

    def _prior(self, index: int, camera: Camera) -> NDArray[np.float32]:
        frame = self.sequence.frame(index)
        return layers.fitted(joint_texture_prior(frame.rgb, frame.tissue_mask), camera)

    def surface(self, look: Look, camera: Camera) -> NDArray[np.float32]:
        """See `Subject.surface`: what was measured."""
        if not look.endoscope:
            return self._dots(look, camera)[1]
        frame = self.sequence.frame(look.frame)
        depth = frame.depth * (frame.depth_valid & (frame.depth >= look.near) & (frame.depth <= look.far))
        return layers.fitted(depth.astype(np.float32), camera)

    def sent(self, look: Look) -> bool:
        """See `Subject.sent`: off the endoscope's place there is nothing but the points."""
        return not look.endoscope

    def cloud(self, look: Look) -> Cloud:
        """See `Subject.cloud`: measured points, the tool's only with the tool laid over."""
        frame, camera = self.sequence.frame(look.frame), self.cameras[look.frame]
        look = replace(look, endoscope=True)
        depth = self.surface(look, camera)
        seen = (depth > 0) & (frame.tissue_mask | look.tool)
        step = int(np.ceil(np.sqrt(max(seen.sum() / MOST_POINTS, 1))))
        rows, columns = (indices * step for indices in np.nonzero(seen[::step, ::step]))
        pixels = pixel_centers(camera.width, camera.height)[rows, columns]
        points = back_project(pixels.astype(np.float64), depth[rows, columns].astype(np.float64), camera)
        colors = self.picture(look, camera)[rows, columns]
        return Cloud(points.astype(np.float32), colors, None, None, step * sum(self.span) / 2 / camera.fy)

    def carry(self, points: NDArray, frames: list[int]) -> NDArray[np.float64]:
        """See `Subject.carry`: nothing is known of the other frames; two points of one frame are known there."""
        paths = np.full((len(self.cameras), *np.shape(points)), np.nan)
        for k, frame in enumerate(frames):
            paths[frame, k] = points[k]
        return paths

    def tracks(self) -> NDArray[np.float64]:
        """See `Subject.tracks`: those of the ground truth, where there are any."""
        tracks = self.sequence.truth.tracks if self.sequence.truth else None
        if tracks is None or not tracks.paired:
            return np.zeros((len(self.cameras), 0, 3))
        poses = np.stack([np.linalg.inv(camera.world_to_camera) for camera in self.cameras])
        world = np.einsum("tij,tpj->tpi", poses[:, :3, :3], tracks.points) + poses[:, None, :3, 3]
        return np.where(tracks.visible[..., None], world, np.nan)

    def legend(self, look: Look) -> str:
        """See `Subject.legend`."""
        unit = "(relative)" if self.relative else "mm"
        return {
            "depth": f"blue {self.span[0]:.1f} to red {self.span[1]:.1f} {unit}",
            "prior": "joint texture prior: blue 0 to red 1",
        }.get(look.layer, "")
