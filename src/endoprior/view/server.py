"""The viewer: the one place that acts. The only module that imports viser.

Controls and cameras call back in threads of viser's; all they do is hand a job to one queue. Whoever calls `work` - a
loop, or a training run between two iterations - runs the jobs and draws, so that nothing is drawn by two threads.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import sys
import time as clock
import traceback
import warnings
from collections import defaultdict
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from ..core.checks import InputError
from . import panel, saving
from .guard import LARGEST_MESSAGE, MOST_BROWSERS, Pace, check_address, sensible, trusted
from .jobs import Jobs
from .marks import Marks, joined, no_marks, ruler, trails
from .measure import Measurement, pick, sentence
from .path import Place, sweep, through
from .session import REST_SECONDS, Look, frame_due
from .stage import Stage, marked_picture, stance
from .subject import Subject
from .viewport import endoscope_viewport

MOST_KEPT = 100
"""Views that a film goes through."""
MOST_PICTURES = 10_000
"""Pictures of one film."""


class _LocalServer(viser.ViserServer):
    """A server that keeps to itself: any client of viser's could ask it to publish the scene through a relay."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class Viewer:
    """A web page that shows a subject. `work` must be called again and again; `run` does that."""

    def __init__(self, subject: Subject, *, host: str = "127.0.0.1", port: int = 0, out: Path | None = None) -> None:
        """Start listening.

        Args:
            host: address to listen on; anything but this machine's own lets others in.
            port: 0 takes any free one.
            out: folder where screenshots and films are kept besides being offered for download; None keeps none.
        Raises:
            InputError: the address cannot be listened on.
        """
        check_address(host, port)
        warnings.filterwarnings("ignore", "Queued a", UserWarning)  # viser's, of every browser that leaves
        self.subject, self.look, self.out, self.host = subject, Look(layer=subject.layers[0]), out, host
        self.measured: Measurement | None = None
        self._jobs = Jobs()
        self._playing: tuple[int, float] | None = None
        """Frame and moment from which the film runs."""
        self._picked: list[tuple[NDArray, int]] = []
        """Points and the frames they were picked in."""
        self._tracks: NDArray | None = None
        self._kept: list[Place] = []
        self._version, self._moved_at = 0, clock.monotonic() - REST_SECONDS
        with contextlib.redirect_stdout(io.StringIO()):  # its banner
            self._server = _LocalServer(host=host, port=port, label="EndoPrior-GS", verbose=False)
        self._keep_out()
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()
        self._server.scene.set_up_direction("-y")
        start = self._server.initial_camera
        start.position, start.look_at, start.up = stance(subject.cameras[0], subject)
        start.fov = endoscope_viewport(subject.cameras[0], 1.0).fov
        self._stage = Stage(self._server)
        self.panel = panel.Panel(self._server.gui, subject, viser.uplot)
        self._listen()
        self._say()

    @property
    def port(self) -> int:
        """The port it listens on."""
        return self._server.get_port()

    @property
    def url(self) -> str:
        """Address for a browser on this machine."""
        host = "127.0.0.1" if self.host in ("0.0.0.0", "::") else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}"

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self._server.get_clients())

    def show(self, subject: Subject) -> None:
        """Show another state of the same scene: as many frames, the same layers. Call it where `work` is called."""
        self.subject, self._tracks = subject, None
        self._version += 1
        self._clear_measurement()

    def run(self) -> None:
        """Work until interrupted."""
        try:
            while True:
                self.work(1.0)
        finally:
            self.close()

    def close(self) -> None:
        """Stop listening."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def work(self, wait: float = 0.0) -> None:
        """Run what was asked for, advance the film, draw what is out of date.

        Args:
            wait: the longest to wait for something to do, s.
        """
        wait = min(wait, self._seconds_to_next())
        for job in self._jobs.take(wait):
            self._attempt(job)
        self._attempt(self._advance)
        self._attempt(self._draw)

    def _seconds_to_next(self) -> float:
        """Until there is something to do unasked: the next frame, or a sharp picture after the hasty ones."""
        if self._playing:
            return 0.01
        rest = self._moved_at + REST_SECONDS - clock.monotonic()
        return max(rest, 0.0) + 0.01 if rest > -REST_SECONDS else float("inf")

    def _attempt(self, job: Callable[[], None]) -> None:
        """Run a job; a failure is told to the browsers and on stderr, and ends neither the viewer nor a training."""
        try:
            job()
        except InputError as error:
            print(f"view: {error}", file=sys.stderr)
            self._stage.notify("That did not work", str(error))
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            self._stage.notify("That did not work", f"{type(error).__name__}: {error}")

    # What is listened to.

    def _listen(self) -> None:
        controls, ask = self.panel, self._jobs.put

        def on_change(job: Callable[[], None], *handles: viser.GuiInputHandle) -> None:
            for handle in handles:  # values that the viewer itself sets come back without a client
                handle.on_update(lambda event: ask(job, job) if event.client is not None else None)

        def on_press(handle: viser.GuiButtonHandle, job: Callable[[viser.ClientHandle], None]) -> None:
            handle.on_click(lambda event: ask(lambda: job(event.client)) if event.client is not None else None)

        on_change(lambda: self._go_to(controls.frame.value), controls.frame)
        shown = controls.layer, controls.camera, controls.drawn_by, controls.drawn_as
        on_change(self._read_panel, *shown, controls.tool, controls.tracks, controls.clip)
        on_change(self._restart_clock, controls.speed)
        on_change(self._read_measuring, controls.measure)
        on_press(controls.play, lambda _: self._toggle_play())
        on_press(controls.clear, lambda _: self._clear_measurement())
        on_press(controls.keep, self._keep_view)
        on_press(controls.forget, lambda _: self._forget_views())
        on_press(controls.screenshot, self._screenshot)
        on_press(controls.film, self._film)
        self._server.on_client_connect(lambda client: ask(lambda: self._welcome(client), surely=True))
        self._server.on_client_disconnect(self._goodbye)

    async def _goodbye(self, client: viser.ClientHandle) -> None:  # async: viser's own threads may have ended by then
        self._jobs.put(lambda: self._stage.leave(client), surely=True)

    # Who is let in, and what is listened to of what they say.

    def _keep_out(self) -> None:
        """Put the guard between the socket and everything else."""
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a traceback for each stranger's garbage
        server = self._server._websock_server
        server._handle_incoming_message = self._guarded(server._handle_incoming_message)
        server.on_client_connect(self._admit)
        for client_id in tuple(server._live_connections):  # who was faster than the line above
            asyncio.run_coroutine_threadsafe(self._judge(client_id), self._server._event_loop)

    async def _admit(self, connection: Any) -> None:
        """Before anything is sent to a connection, or read from it."""
        connection._handle_incoming_message = self._guarded(connection._handle_incoming_message)
        await self._judge(connection.client_id)

    async def _judge(self, client_id: int) -> None:
        """Close the connection of a page that is not ours, and one too many."""
        connections = self._server._websock_server._live_connections
        if (connection := connections.get(client_id)) is None:
            return
        connection.protocol.max_message_size = LARGEST_MESSAGE
        if not self._trusts(client_id):
            await connection.close(1008, "not this viewer's page")
        elif len(connections) > MOST_BROWSERS:
            await connection.close(1013, "too many browsers")

    def _trusts(self, client_id: int) -> bool:
        """Whether a connection that is open may be served."""
        connection = self._server._websock_server._live_connections.get(client_id)
        if connection is None:
            return False
        origins, hosts = (connection.request.headers.get_all(name) for name in ("Origin", "Host"))
        return len(origins) < 2 and trusted(next(iter(origins), None), next(iter(hosts), None), self.host)

    def _guarded(self, handle: Callable[[int, Any], Awaitable[None]]) -> Callable[[int, Any], Awaitable[None]]:
        """`handle` of those messages only that make sense and come from our pages; a flood ends its connection."""
        paces: defaultdict[int, Pace] = defaultdict(Pace)

        async def guarded(client_id: int, message: Any) -> None:
            controls = getattr(self, "panel", None)  # there are none yet while the viewer starts
            accepts = controls.accepts if controls else lambda uuid, value: False
            connection = self._server._websock_server._live_connections.get(client_id)
            if connection is None:
                paces.pop(client_id, None)
            elif paces[client_id].exceeded(clock.monotonic()):
                connection.transport.abort()
            elif self._trusts(client_id) and sensible(type(message).__name__, vars(message), accepts):
                await handle(client_id, message)

        return guarded

    def _welcome(self, client: viser.ClientHandle) -> None:
        self._stage.join(client)
        client.camera.on_update(lambda _: self._jobs.put(self._camera_moved, self._camera_moved))

    def _camera_moved(self) -> None:
        if not self.look.endoscope:
            self._moved_at = clock.monotonic()

    def _read_panel(self) -> None:
        look = self.panel.chosen(self.look)
        if look.endoscope and not self.look.endoscope:
            self._stage.return_to_endoscope()
        self.look = look
        self._say()

    def _go_to(self, frame: int) -> None:
        self._moved_at = clock.monotonic()
        self.look = replace(self.look, frame=min(max(frame, 0), len(self.subject.cameras) - 1))
        self._restart_clock()
        self._say()

    # The clock.

    def _toggle_play(self) -> None:
        self._playing = None if self._playing else (self.look.frame, clock.monotonic())
        self.panel.play.label = "Pause" if self._playing else "Play"

    def _restart_clock(self) -> None:
        if self._playing:
            self._playing = self.look.frame, clock.monotonic()

    def _advance(self) -> None:
        if not self._playing:
            return
        start, since = self._playing
        rate, total = self.subject.frames_per_second * self.panel.rate, len(self.subject.cameras)
        frame = frame_due(start, clock.monotonic() - since, rate, total)
        if frame != self.look.frame:
            self._moved_at = clock.monotonic()
            self.look = replace(self.look, frame=frame)
            self.panel.frame.value = frame
            self._say()

    # Drawing.

    def _draw(self) -> None:
        marks = self._marks(self.look)
        self._stage.draw(self.subject, self._version, self.look, marks, clock.monotonic() - self._moved_at)

    def _marks(self, look: Look) -> Marks:
        marks = no_marks()
        if look.tracks:
            if self._tracks is None:
                self._tracks = self.subject.tracks()
            if self._tracks.shape[1]:
                marks = trails(self._tracks, look.frame)
        return joined(marks, ruler(self.measured.ends(look.frame))) if self.measured else marks

    # Measuring.

    def _read_measuring(self) -> None:
        scene = self._server.scene
        scene.remove_click_callback("all")
        if self.panel.measure.value:
            scene.on_click()(lambda event: self._jobs.put(lambda: self._pick(event.client, event.screen_pos)))
        self._say()

    def _pick(self, client: viser.ClientHandle, screen: tuple[float, float]) -> None:
        """Take the point under a click: the first, the second, or the first of the next measurement."""
        viewport = self._stage.viewport(client, self.subject, self.look)
        if viewport is None:
            return
        depth = self.subject.surface(self.look, viewport.camera)
        point = pick(depth, viewport.camera, viewport.pixel(screen))
        if point is None:
            self._stage.notify("No surface there", "Click where something is drawn.")
            return
        before = self._picked if len(self._picked) < 2 else []
        self._picked = [*before, (point, self.look.frame)]
        points, frames = zip(*self._picked, strict=True)
        self.measured = Measurement(self.look.frame, self.subject.carry(np.stack(points), list(frames)))
        self._say()

    def _clear_measurement(self) -> None:
        self.measured, self._picked = None, []
        self._say()

    # Saving.

    def _keep_view(self, client: viser.ClientHandle) -> None:
        viewport = self._stage.viewport(client, self.subject, self.look)
        if len(self._kept) >= MOST_KEPT:
            self._stage.notify("Not kept", f"{MOST_KEPT} views are enough for one film.")
        elif viewport is not None:
            self._kept.append(Place(self.look.frame, viewport.camera))
        self._say()

    def _forget_views(self) -> None:
        self._kept = []
        self._say()

    def _screenshot(self, client: viser.ClientHandle) -> None:
        viewport = self._stage.viewport(client, self.subject, self.look)
        if viewport is None:
            return
        picture = marked_picture(self.subject, self.look, viewport.camera, self._marks(self.look))
        self._offer(client, f"{self.look.layer}_{self.look.frame:06d}.png", saving.png_bytes(picture))

    def _film(self, client: viser.ClientHandle) -> None:
        viewport = self._stage.viewport(client, self.subject, self.look)
        if viewport is None:
            return
        look, places = self.look, sweep(self.subject.cameras, None if self.look.endoscope else viewport.camera)
        if len(self._kept) > 1:
            look, places = replace(look, endoscope=False), through(self._kept)
        if len(places) > MOST_PICTURES:
            self._stage.notify("No film", f"Expected at most {MOST_PICTURES} pictures; got {len(places)}.")
            return
        self._stage.notify("Drawing the film", f"{len(places)} pictures")
        looks = [replace(look, frame=place.frame) for place in places]
        pictures = (  # one at a time: all of them may not fit into memory
            marked_picture(self.subject, look, place.camera, self._marks(look))
            for look, place in zip(looks, places, strict=True)
        )
        self._offer(client, f"{look.layer}.mp4", saving.mp4_bytes(pictures, self.subject.frames_per_second))

    def _offer(self, client: viser.ClientHandle, name: str, content: bytes) -> None:
        """Send a file to the browser, and keep it in the folder for such files."""
        client.send_file_download(name, content)
        if self.out is not None:
            self._stage.notify("Saved", str(saving.keep(self.out, name, content)))

    # Telling.

    def _say(self) -> None:
        """Bring the words of the panel up to date."""
        controls, measuring = self.panel, self.measured or self.panel.measure.value
        controls.status.content = panel.status(self.subject, self.look, len(self._kept))
        told = sentence(self.measured, self.look.frame, self.subject.relative) if measuring else ""
        controls.distance.content = told
        distances = self.measured.distances if self.measured else np.zeros(0)
        controls.chart.visible = bool(np.isfinite(distances).sum() > 1)
        if controls.chart.visible:
            controls.chart.data = np.arange(len(distances), dtype=np.float64), distances
