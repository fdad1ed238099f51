"""What each connected browser shows, brought up to date: a picture behind an empty scene, or things it draws itself."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.types import Camera
from .guard import is_camera
from .marks import Marks, draw_marks
from .session import REST_SECONDS, Look, shrink_factor
from .subject import Subject
from .viewport import Viewport, bounded_aspect, endoscope_viewport, free_viewport

if TYPE_CHECKING:
    import viser

HASTY_QUALITY = 80
"""JPEG quality of pictures while something moves; those that stay are PNG, exact to the bit."""
CAMERA_FIELDS = ("wxyz", "position", "look_at", "up_direction", "fov")
SPLATS_NODE, POINTS_NODE, MARKS_NODE = "/splats", "/points", "/marks"


@dataclass
class _Browser:
    """What one connected browser was last told."""

    client: viser.ClientHandle
    pose: tuple | None = None
    """Endoscope pose and angle its camera was set to."""
    drawn: tuple | None = None
    """What its picture shows, and whether it is a hasty one; None for no picture."""


class Stage:
    """The browsers of one server. Everything here runs in the thread that draws."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._browsers: dict[int, _Browser] = {}
        self._sent: tuple | None = None
        self._full_ms = 0.0

    def join(self, client: viser.ClientHandle) -> None:
        """A browser connected."""
        self._browsers[client.client_id] = _Browser(client)

    def leave(self, client: viser.ClientHandle) -> None:
        """A browser went away."""
        self._browsers.pop(client.client_id, None)

    def notify(self, title: str, body: str) -> None:
        """Show a note in every browser for a few seconds."""
        for browser in self._connected():
            browser.client.add_notification(title, body, auto_close_seconds=5.0)

    def _connected(self) -> list[_Browser]:
        """Those of whom we do not know yet that they have left may have left."""
        clients = self._server.get_clients()
        return [browser for number, browser in list(self._browsers.items()) if number in clients]

    def return_to_endoscope(self) -> None:
        """The browsers' cameras were moved away and are to be put back."""
        for browser in self._browsers.values():
            browser.pose = None

    def viewport(self, client: viser.ClientHandle, subject: Subject, look: Look, shrink: int = 1) -> Viewport | None:
        """What a browser's canvas shows at this moment; None if it sent no sensible camera."""
        camera, own = client.camera, subject.cameras[look.frame]
        aspect = bounded_aspect(camera.image_width, camera.image_height)
        if look.endoscope:
            return endoscope_viewport(own, aspect, shrink)
        if not is_camera({name: np.asarray(getattr(camera, name)).tolist() for name in CAMERA_FIELDS}):
            return None
        return free_viewport(camera.wxyz, camera.position, camera.fov, aspect, own.height, shrink)

    def draw(self, subject: Subject, version: int, look: Look, marks: Marks, still_seconds: float) -> None:
        """Bring every browser up to date.

        Args:
            version: another number says that the subject draws differently than before.
            still_seconds: time since something moved.
        """
        sent = subject.sent(look)
        self._send_nodes(subject, version, look, marks, sent)
        for browser in self._connected():
            if look.endoscope:
                self._follow_endoscope(browser, subject, look)
            if not sent:
                self._send_picture(browser, subject, version, look, marks, still_seconds)
            elif browser.drawn is not None:
                browser.client.scene.set_background_image(None)
                browser.drawn = None

    def _send_picture(
        self, browser: _Browser, subject: Subject, version: int, look: Look, marks: Marks, still_seconds: float
    ) -> None:
        shrink = shrink_factor(still_seconds, self._full_ms)
        viewport = self.viewport(browser.client, subject, look, shrink)
        if viewport is None:
            return
        camera, hasty = viewport.camera, still_seconds < REST_SECONDS
        seen_from = camera.width, camera.height, camera.fy, camera.world_to_camera.tobytes(), viewport.width
        wanted = version, look, seen_from, marks.segments.tobytes()
        # A hasty picture is sent once more when all is still.
        if browser.drawn is not None and browser.drawn[0] == wanted and (hasty or not browser.drawn[1]):
            return
        began = clock.perf_counter()
        picture = marked_picture(subject, look, camera, marks)
        if shrink == 1:
            self._full_ms = 1e3 * (clock.perf_counter() - began)
        scene = browser.client.scene
        scene.set_background_image(viewport.paste(picture), "jpeg" if hasty else "png", jpeg_quality=HASTY_QUALITY)
        browser.client.flush()
        browser.drawn = wanted, hasty

    def _send_nodes(self, subject: Subject, version: int, look: Look, marks: Marks, sent: bool) -> None:
        """What browsers draw themselves: nothing, or a cloud and the marks."""
        wanted = (version, look, marks.segments.tobytes()) if sent else None
        if wanted == self._sent:
            return
        self._sent, scene = wanted, self._server.scene
        with self._server.atomic():
            cloud = subject.cloud(look) if sent else None
            splats = cloud is not None and cloud.covariances is not None
            for name, gone in (
                (SPLATS_NODE, not splats),
                (POINTS_NODE, cloud is None or splats),
                (MARKS_NODE, cloud is None or not len(marks)),
            ):
                if gone and scene.get_handle_by_name(name) is not None:
                    scene.remove_by_name(name)
            if cloud is None:
                return
            if splats:
                colors, opacities = cloud.colors / 255.0, cloud.opacities[:, None]
                scene.add_gaussian_splats(SPLATS_NODE, cloud.points, cloud.covariances, colors, opacities)
            else:
                look_of_points = {"point_size": cloud.size, "point_shape": "circle", "precision": "float32"}
                scene.add_point_cloud(POINTS_NODE, cloud.points, cloud.colors, **look_of_points)
            if len(marks):
                colors = np.repeat(marks.colors[:, None], 2, 1)
                scene.add_line_segments(MARKS_NODE, marks.segments, colors, thickness=3.0, thickness_units="screen")

    def _follow_endoscope(self, browser: _Browser, subject: Subject, look: Look) -> None:
        """Put the browser's camera where the endoscope is."""
        viewport = self.viewport(browser.client, subject, look)
        pose = viewport.camera.world_to_camera.tobytes(), round(viewport.fov, 4)
        if browser.pose == pose:
            return
        browser.pose = pose
        camera = browser.client.camera
        with browser.client.atomic():
            camera.position, camera.look_at, camera.up_direction = stance(viewport.camera, subject)
            camera.fov = viewport.fov


def marked_picture(subject: Subject, look: Look, camera: Camera, marks: Marks) -> NDArray[np.uint8]:
    """(H, W, 3) the picture with the marks over it."""
    picture = subject.picture(look, camera)
    return draw_marks(picture, camera, marks) if len(marks) else picture


def stance(camera: Camera, subject: Subject) -> tuple[NDArray, NDArray, NDArray]:
    """Where a camera is, the point in the middle of the tissue that it looks at, and which way is up for it."""
    axes = camera.world_to_camera[:3, :3]
    return camera.center, camera.center + axes[2] * sum(subject.span) / 2, -axes[1]
