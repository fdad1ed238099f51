"""Update each connected browser: with a rendered background image, or with a point cloud or splats to render itself."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.types import Camera
from ..export.formats import Progress
from .layers import Lines, draw_lines
from .viewable import IDLE_SECONDS, ViewSettings, shrink_factor
from .viewport import Viewport, bounded_aspect, endoscope_viewport, free_viewport

if TYPE_CHECKING:
    import viser

    from .viewable_sequence import Viewable

PREVIEW_QUALITY = 80
"""JPEG quality of images while something moves; static images are PNG (lossless)."""
SPLATS_NODE, POINTS_NODE, LINES_NODE = "/splats", "/points", "/lines"


@dataclass
class _Browser:
    client: viser.ClientHandle
    pose: tuple | None = None
    """Endoscope pose and field of view that its camera was set to."""
    shown: tuple | None = None
    """Content of its background image, and whether it is a preview; None for no image."""


class Browsers:
    """The browsers of one server. All methods run in the rendering thread."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._browsers: dict[int, _Browser] = {}
        self._sent: tuple | None = None
        self._full_ms = 0.0

    def join(self, client: viser.ClientHandle) -> None:
        self._browsers[client.client_id] = _Browser(client)

    def leave(self, client: viser.ClientHandle) -> None:
        self._browsers.pop(client.client_id, None)

    def notify(self, title: str, body: str) -> None:
        """Show a notification in every browser for a few seconds."""
        for browser in self._connected():
            browser.client.add_notification(title, body, auto_close_seconds=5.0)

    @contextmanager
    def progress(self, title: str) -> Iterator[Progress]:
        """Show in every browser how much of something long is done, until it ends: images stand still meanwhile."""
        clients = [browser.client for browser in self._connected()]
        shown = [each.add_notification(title, "", loading=True, with_close_button=False) for each in clients]

        def progress(done: int, total: int) -> None:
            for notification in shown:
                notification.body = f"{done} of {total}"

        try:
            yield progress
        finally:
            for notification in shown:
                notification.remove()

    def _connected(self) -> list[_Browser]:
        """Browsers that are still connected; `leave` may not have been called yet."""
        clients = self._server.get_clients()
        return [browser for number, browser in self._browsers.items() if number in clients]

    def return_to_endoscope(self) -> None:
        """Reset the camera of every browser to the endoscope at the next update."""
        for browser in self._browsers.values():
            browser.pose = None

    def ride(self, before: Camera, now: Camera) -> None:
        """Move the camera of every browser as the endoscope moves from `before` to `now`."""
        move = np.linalg.inv(now.world_to_camera) @ before.world_to_camera
        if np.allclose(move, np.eye(4), atol=1e-12):
            return
        for browser in self._connected():
            camera = browser.client.camera
            places = [move[:3, :3] @ place + move[:3, 3] for place in (camera.position, camera.look_at)]
            with browser.client.atomic():
                camera.position, camera.look_at = places
                camera.up_direction = move[:3, :3] @ camera.up_direction

    def draw(self, viewable: Viewable, version: int, settings: ViewSettings, lines: Lines, idle_seconds: float) -> None:
        """Update every browser.

        Args:
            version: changes when the content of `viewable` changes.
            idle_seconds: time since the last motion.
        """
        content = version, settings, lines.segments.tobytes()
        sent = viewable.renders_in_browser(settings)
        if self._sent != (content if sent else None):
            self._sent = content if sent else None
            self._send_nodes(viewable, settings, lines, sent)
        shrink, preview = shrink_factor(idle_seconds, self._full_ms), idle_seconds < IDLE_SECONDS
        for browser in self._connected():
            client = browser.client
            if settings.endoscope:
                _follow_endoscope(browser, viewable, settings)
            if sent:
                if browser.shown is not None:
                    client.scene.set_background_image(None)
                    browser.shown = None
                continue
            viewport = viewport_of(client, viewable, settings, shrink)
            if viewport is None:
                continue
            camera, shown = viewport.camera, browser.shown
            canvas = viewport.width, viewport.height
            wanted = content, camera.width, camera.height, camera.fy, camera.world_to_camera.tobytes(), canvas
            # After a preview, send the full image once nothing moves.
            if shown is not None and shown[0] == wanted and (preview or not shown[1]):
                continue
            began = clock.perf_counter()
            picture = viewport.paste(picture_with_lines(viewable, settings, camera, lines))
            if shrink == 1:
                self._full_ms = 1e3 * (clock.perf_counter() - began)
            client.scene.set_background_image(picture, "jpeg" if preview else "png", jpeg_quality=PREVIEW_QUALITY)
            client.flush()
            browser.shown = wanted, preview

    def _send_nodes(self, viewable: Viewable, settings: ViewSettings, lines: Lines, sent: bool) -> None:
        """Update the objects that browsers render themselves: nothing, or a cloud and the lines."""
        scene = self._server.scene
        with self._server.atomic():
            cloud = viewable.cloud(settings) if sent else None
            splats = cloud is not None and cloud.covariances is not None
            shown = {SPLATS_NODE: splats, POINTS_NODE: sent and not splats, LINES_NODE: sent and len(lines) > 0}
            for name in shown:
                if not shown[name] and scene.get_handle_by_name(name) is not None:
                    scene.remove_by_name(name)
            if cloud is None:
                return
            if cloud.covariances is not None:
                colors, opacities = cloud.colors / 255.0, cloud.opacities[:, None]
                scene.add_gaussian_splats(SPLATS_NODE, cloud.points, cloud.covariances, colors, opacities)
            else:
                look = {"point_size": cloud.size, "point_shape": "circle", "precision": "float32"}
                scene.add_point_cloud(POINTS_NODE, cloud.points, cloud.colors, **look)
            if len(lines):
                colors = np.repeat(lines.colors[:, None], 2, 1)
                scene.add_line_segments(LINES_NODE, lines.segments, colors, thickness=3.0, thickness_units="screen")


def viewport_of(
    client: viser.ClientHandle, viewable: Viewable, settings: ViewSettings, shrink: int = 1
) -> Viewport | None:
    """The current viewport of a browser; None if its camera is invalid."""
    camera, own = client.camera, viewable.cameras[settings.frame]
    aspect = bounded_aspect(camera.image_width, camera.image_height)
    if settings.endoscope:
        return endoscope_viewport(own, aspect, shrink)
    return free_viewport(camera.wxyz, camera.position, camera.fov, aspect, own.height, shrink)


def _follow_endoscope(browser: _Browser, viewable: Viewable, settings: ViewSettings) -> None:
    """Set the browser's camera to the endoscope camera."""
    camera = browser.client.camera
    aspect = bounded_aspect(camera.image_width, camera.image_height)
    viewport = endoscope_viewport(viewable.cameras[settings.frame], aspect)
    pose = viewport.camera.world_to_camera.tobytes(), round(viewport.fov, 4)
    if browser.pose != pose:
        browser.pose = pose
        with browser.client.atomic():
            camera.position, camera.look_at, camera.up_direction = camera_pose(viewport.camera, viewable)
            camera.fov = viewport.fov


def picture_with_lines(viewable: Viewable, settings: ViewSettings, camera: Camera, lines: Lines) -> NDArray[np.uint8]:
    """(H, W, 3) image with the lines drawn over it."""
    picture = viewable.picture(settings, camera)
    return draw_lines(picture, camera, lines) if len(lines) else picture


def camera_pose(camera: Camera, viewable: Viewable) -> tuple[NDArray, NDArray, NDArray]:
    """Position of a camera, the point at mid depth that it looks at, and its up direction."""
    axes = camera.world_to_camera[:3, :3]
    return camera.center, camera.center + axes[2] * sum(viewable.span) / 2, -axes[1]
