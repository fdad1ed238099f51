"""The viewer server.

Callbacks of controls and cameras run in viser's threads; they only add jobs to a queue. The thread that calls `work` (a
loop, or a training run between two iterations) runs the jobs and renders. Rendering therefore has a single thread.
"""

from __future__ import annotations

import contextlib
import io
import ipaddress
import secrets
import sys
import time as clock
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import viser
from numpy.typing import NDArray
from typing_extensions import override

from ..core.checks import InputError
from ..core.types import Camera
from ..data.images import encode_png
from ..system.console import complain
from . import panel
from .access_control import access_control
from .addresses import Names, check_address
from .browsers import Browsers, camera_pose, picture_with_lines, viewport_of
from .incoming import Job, JobQueue, RateLimit
from .layers import Lines
from .mask_editor import MaskEditor, Spot
from .measure import DrawnTracks, Measuring, pick
from .saving import SCENE_FILES, keep, scene_file, video_file
from .viewable import IDLE_SECONDS, ViewSettings, frame_due
from .viewport import PathPoint, Viewport, endoscope_viewport, follow_frames, interpolate

if TYPE_CHECKING:
    from .viewable_sequence import Viewable

MAX_KEPT = 100
"""Largest number of saved views."""
MAX_PICTURES = 10_000
"""Largest number of images of a video."""
ClientJob = Callable[[viser.ClientHandle], object]


class _LocalServer(viser.ViserServer):
    """A server that never publishes the scene; viser lets any client request a public URL."""

    @override
    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class Viewer:
    """A web page that shows a scene or a sequence. Call `work` repeatedly, or `run`."""

    def __init__(
        self, viewable: Viewable, *, host: str = "127.0.0.1", port: int = 0, out: Path | None = None, names: Names = ()
    ) -> None:
        """Start listening.

        Args:
            host: address to listen on; other machines can connect to any but the loopback address.
            port: 0 uses any free port. names: others of this machine in the address of the page, as that of a proxy.
            out: folder to store what is saved, in addition to the download; None stores none.
        Raises:
            InputError: the address cannot be used.
        """
        check_address(host, port)
        warnings.filterwarnings("ignore", "Queued a", UserWarning)  # from viser, when a browser disconnects
        self.viewable, self.settings, self.out, self.host = viewable, ViewSettings(layer=viewable.layers[0]), out, host
        self.jobs, self.tracks = JobQueue(), DrawnTracks(viewable)
        self.kept_views: list[PathPoint] = []
        self._playing: tuple[int, float] | None = None  # frame and time at the start of playback
        self._version, self._moved_at = 0, clock.monotonic() - IDLE_SECONDS
        self._token = secrets.token_urlsafe(24)
        with contextlib.redirect_stdout(io.StringIO()), access_control(self._token, host, self._accepts, names):
            self.server = _LocalServer(host=host, port=port, label="EndoPrior-GS", verbose=False)  # prints a banner
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self.server.scene.set_up_direction("-y")
        start = self.server.initial_camera
        start.position, start.look_at, start.up = camera_pose(viewable.cameras[0], viewable)
        start.fov = endoscope_viewport(viewable.cameras[0], 1.0).fov
        self._browsers = Browsers(self.server)
        self.panel = panel.Panel(self.server.gui, viewable)
        self.measuring = Measuring(self.panel)
        edits = viewable.mask_edits
        self._editor = edits and MaskEditor(
            edits, self.panel, self.server.scene, self.jobs, self._mask_spot, self._masks_changed
        )
        self._listen()
        self._update_panel()

    @property
    def port(self) -> int:
        return self.server.get_port()

    @property
    def url(self) -> str:
        """Address for a browser on this machine, with the token: who has it can use the viewer."""
        host = self.host
        with contextlib.suppress(ValueError):
            address = ipaddress.ip_address(host)
            if address.is_unspecified:
                host = "127.0.0.1" if address.version == 4 else "::1"
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self._token}/"

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self.server.get_clients())

    def show(self, viewable: Viewable) -> None:
        """Show another state of the scene, with the same layers; its next window may have another number of frames.

        Call it in the thread of `work`.
        """
        if (total := len(viewable.cameras)) != len(self.viewable.cameras):
            frame, since = (min(value, total - 1) for value in (self.settings.frame, self.settings.since))
            self.settings, self.kept_views = replace(self.settings, frame=frame, since=since), []
            self.panel.set_length(total, self.settings)
            self._restart_clock()
        self.viewable, self.tracks = viewable, DrawnTracks(viewable)
        self._version += 1
        self.measuring.clear()
        self._update_panel()

    def run(self) -> None:
        """Call `work` until interrupted."""
        try:
            while True:
                self.work(1.0)
        finally:
            self.close()

    def close(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def work(self, wait: float = 0.0) -> None:
        """Run waiting jobs, advance playback, render what changed; wait at most `wait` s for a job."""
        rest = self._moved_at + IDLE_SECONDS - clock.monotonic()
        if self._playing:
            wait = min(wait, 0.01)
        elif rest > -IDLE_SECONDS:  # until the image of full size after a motion
            wait = min(wait, max(rest, 0.0) + 0.01)
        for job in (*self.jobs.take(wait), self._advance, self._draw):
            try:
                job()
            except Exception as error:  # stops neither the viewer nor a training
                known = isinstance(error, InputError)
                complain(f"view: {error}") if known else traceback.print_exc(file=sys.stderr)
                self._browsers.notify("That did not work", str(error) if known else f"{type(error).__name__}: {error}")

    def _accepts(self, uuid: str, value: Any) -> bool:
        return hasattr(self, "panel") and self.panel.accepts(uuid, value)  # there is no panel while the viewer starts

    # Callbacks of the controls.

    def _listen(self) -> None:
        controls, ask, on_press, on_choice = self.panel, self.jobs.put, self._on_press, self._on_choice

        def on_change(job: Job, *handles: Any) -> None:
            for handle in handles:  # values set by the viewer itself arrive without a client
                handle.on_update(lambda event: ask(job, job) if event.client is not None else None)

        def on_save(job: ClientJob, handle: viser.GuiButtonHandle) -> None:
            on_press(limited(job), handle, job)

        on_change(lambda: self._go_to(controls.frame.value), controls.frame)
        on_change(self.read_panel, controls.layer, controls.camera, controls.riding, controls.rendered_by)
        on_change(self.read_panel, controls.rendered_as, controls.tool, controls.smoke, controls.tracks, controls.clip)
        on_change(self.read_panel, controls.correct, controls.since)
        on_change(self._restart_clock, controls.speed)
        on_change(self.read_clicking, controls.measure, controls.follow, controls.quantity)
        on_press(lambda _client: self._toggle_play(), controls.play)
        cleared = partial(self._then_update, self.measuring.clear)
        on_choice({panel.CLEAR: lambda _client: cleared(), panel.TABLE: limited(self._save_table)}, controls.points)
        on_press(lambda _client: self.tracks.clear(), controls.clear_tracks)
        on_press(self._keep_view, controls.keep)
        on_press(lambda _client: self._then_update(self.kept_views.clear), controls.forget)
        on_save(lambda _client: self.measuring.save_scale(self.viewable), controls.save_scale)
        views = {panel.IMAGE: limited(self._save_image), panel.VIDEO: limited(self._save_video)}
        on_choice(views, controls.save_view)
        on_choice({name: limited(partial(self._save_scene, name)) for name in SCENE_FILES}, controls.save_scene)
        if editor := self._editor:
            on_press(lambda _client: editor.undo(), controls.undo)
            on_press(lambda _client: editor.carry(self.settings.frame), controls.carry)
            on_save(lambda _client: editor.save(), controls.save_masks)
        self.server.on_client_connect(lambda client: ask(lambda: self._welcome(client), surely=True))
        self.server.on_client_disconnect(self._goodbye)

    def _on_press(self, job: ClientJob, handle: viser.GuiButtonHandle, key: object = None) -> None:
        def pressed(event: viser.GuiEvent) -> None:
            if (client := event.client) is not None:
                self.jobs.put(lambda: job(client), key)

        handle.on_click(pressed)

    def _on_choice(self, jobs: Mapping[str, ClientJob], handle: viser.GuiButtonGroupHandle) -> None:
        async def pressed(event: viser.GuiEvent) -> None:  # async: before the next press changes the value
            name = handle.value
            if (client := event.client) is not None:
                self.jobs.put(lambda: jobs[name](client), name)

        handle.on_click(pressed)

    async def _goodbye(self, client: viser.ClientHandle) -> None:  # async: viser's threads may have ended
        self.jobs.put(lambda: self._browsers.leave(client), surely=True)

    def _welcome(self, client: viser.ClientHandle) -> None:
        self._browsers.join(client)
        client.camera.on_update(lambda _: self.jobs.put(self._camera_moved, self._camera_moved))

    def _camera_moved(self) -> None:
        if not self.settings.endoscope:
            self._moved_at = clock.monotonic()

    def read_panel(self) -> None:
        """Update the settings from the controls."""
        settings, before = self.panel.chosen(self.settings), self.settings
        self.settings = settings
        if settings.endoscope and not before.endoscope:
            self._browsers.return_to_endoscope()
        if settings.since != before.since:
            self.measuring.update(self.viewable, settings)
        if self._editor:
            self._editor.listen(settings.correcting and settings.endoscope)
        self._update_panel()

    def _then_update(self, job: Job) -> None:
        job()
        self._update_panel()

    def _update_panel(self) -> None:
        self.panel.status.content = panel.status(self.viewable, self.settings, len(self.kept_views))
        self.measuring.show(self.viewable, self.settings.frame)

    # Frames.

    def _go_to(self, frame: int) -> None:
        self._set_frame(min(max(frame, 0), len(self.viewable.cameras) - 1))
        self._restart_clock()

    def _set_frame(self, frame: int) -> None:
        self._moved_at = clock.monotonic()
        if self.settings.riding and not self.settings.endoscope:
            self._browsers.ride(self.viewable.cameras[self.settings.frame], self.viewable.cameras[frame])
        self.settings = replace(self.settings, frame=frame)
        self._update_panel()

    def _toggle_play(self) -> None:
        self._playing = None if self._playing else (self.settings.frame, clock.monotonic())
        self.panel.play.label = "Pause" if self._playing else "Play"

    def _restart_clock(self) -> None:
        if self._playing:
            self._playing = self.settings.frame, clock.monotonic()

    def _advance(self) -> None:
        if not self._playing:
            return
        start, since = self._playing
        rate, total = self.viewable.frames_per_second * self.panel.rate, len(self.viewable.cameras)
        frame = frame_due(start, clock.monotonic() - since, rate, total)
        if frame != self.settings.frame:
            self._set_frame(frame)
            self.panel.frame.value = frame

    def _draw(self) -> None:
        lines, idle_seconds = self._lines(self.settings), clock.monotonic() - self._moved_at
        self._browsers.draw(self.viewable, self._version, self.settings, lines, idle_seconds)

    def _lines(self, settings: ViewSettings) -> Lines:
        return self.tracks.lines(settings.frame, settings.tracks) + self.measuring.lines(settings.frame)

    def _picture(self, settings: ViewSettings, camera: Camera) -> NDArray[np.uint8]:
        return picture_with_lines(self.viewable, settings, camera, self._lines(settings))

    def _viewport(self, client: viser.ClientHandle) -> Viewport | None:
        return viewport_of(client, self.viewable, self.settings)

    # Clicks: tracks, measures, tool masks.

    def read_clicking(self) -> None:
        """Switch clicks on the tissue on or off, and measure what is chosen, as the controls are set."""
        scene = self.server.scene
        scene.remove_click_callback(self._on_click)
        if self.panel.measure.value or self.panel.follow.value:
            scene.on_click()(self._on_click)
        self.measuring.update(self.viewable, self.settings)
        self._update_panel()

    def _on_click(self, event: viser.SceneClickEvent) -> None:
        self.jobs.put(lambda: self._pick(event.client, event.screen_pos))

    def _pick(self, client: viser.ClientHandle, screen: tuple[float, float]) -> None:
        """Track the point under a click, or measure it."""
        viewport = self._viewport(client)
        if viewport is None or self.settings.correcting:  # a click paints
            return
        depth = self.viewable.surface(self.settings, viewport.camera)
        point = pick(depth, viewport.camera, viewport.pixel(screen))
        if point is None:
            self._browsers.notify("No surface there", "Click on the tissue.")
            return
        if self.panel.follow.value:
            self.tracks.pick(point, self.settings.frame)
        if self.panel.measure.value:
            self.measuring.add(point, self.viewable, self.settings)
        self._update_panel()

    def _mask_spot(self, client: viser.ClientHandle, screen: tuple[float, float]) -> Spot | None:
        """The frame, and the position in its mask, at a position on a browser's canvas."""
        viewport = self._viewport(client)
        if viewport is None or not self.settings.endoscope:
            return None
        (x, y), own = viewport.pixel(screen), self.viewable.cameras[self.settings.frame]
        return self.settings.frame, (x * own.width / viewport.camera.width, y * own.height / viewport.camera.height)

    def _masks_changed(self) -> None:
        self._version += 1
        self._moved_at = clock.monotonic()

    # Saving.

    def _keep_view(self, client: viser.ClientHandle) -> None:
        viewport = self._viewport(client)
        if len(self.kept_views) >= MAX_KEPT:
            self._browsers.notify("Not saved", f"The limit is {MAX_KEPT} views.")
        elif viewport is not None:
            self.kept_views.append(PathPoint(self.settings.frame, viewport.camera))
        self._update_panel()

    def _save_image(self, client: viser.ClientHandle) -> None:
        if (viewport := self._viewport(client)) is not None:
            picture = encode_png(self._picture(self.settings, viewport.camera))
            self._offer(client, f"{self.settings.layer}_{self.settings.frame:06d}.png", picture)

    def _save_video(self, client: viser.ClientHandle) -> None:
        settings, viewport = self.settings, self._viewport(client)
        if viewport is None:
            return
        if len(self.kept_views) > 1:
            settings, places = replace(settings, endoscope=False), interpolate(self.kept_views)
        elif settings.endoscope:
            places = follow_frames(self.viewable.cameras)
        else:
            rides_from = settings.frame if settings.riding else None
            places = follow_frames(self.viewable.cameras, viewport.camera, rides_from)
        if len(places) > MAX_PICTURES:
            self._browsers.notify("No video", f"Expected at most {MAX_PICTURES} images, got {len(places)}.")
            return
        with self._browsers.progress("Rendering the video") as progress:

            def pictures() -> Iterator[NDArray[np.uint8]]:  # one at a time: all together may not fit into memory
                for k, place in enumerate(places):
                    yield self._picture(replace(settings, frame=place.frame), place.camera)
                    progress(k + 1, len(places))

            content = video_file(pictures(), self.viewable.frames_per_second)
        self._offer(client, f"{settings.layer}.mp4", content)

    def _save_scene(self, button: str, client: viser.ClientHandle) -> None:
        if (scene := self.viewable.scene) is None:
            return
        with self._browsers.progress(f"Writing the model: {button}") as progress:
            name, content = scene_file(scene, button, self.settings.frame, progress)
        self._offer(client, name, content)

    def _save_table(self, client: viser.ClientHandle) -> None:
        table = self.measuring.table(self.viewable, self.settings)
        if table is None:
            self._browsers.notify("Nothing measured", "Check Measure by clicking, and click points.")
        else:
            self._offer(client, "measures.csv", table.encode())

    def _offer(self, client: viser.ClientHandle, name: str, content: bytes) -> None:
        """Send a file to the browser, and store it in `out`."""
        client.send_file_download(name, content)
        if self.out is not None:
            self._browsers.notify("Saved", str(keep(self.out, name, content)))


def limited(job: ClientJob) -> ClientJob:
    """`job`, at most once per second: more would fill the disk."""
    rate = RateLimit(1)
    return lambda client: rate.exceeded(clock.monotonic()) or job(client)
