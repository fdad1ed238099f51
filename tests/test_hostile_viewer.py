"""A viewer under attack: malformed requests and messages, floods. It keeps serving images; see `test_view_access`."""

import base64
import os
import socket
import struct
import threading
import time
from contextlib import suppress
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
from export_scenes import moving_scene
from view_client import VISER, Client, at_work, camera_message
from websockets.exceptions import ConnectionClosed, InvalidStatus

from endoprior.core.checks import InputError
from endoprior.view import panel as panels
from endoprior.view.access_control import MAX_BROWSERS, MAX_MESSAGE_BYTES
from endoprior.view.incoming import MAX_WAITING, JobQueue, is_valid_message
from endoprior.view.panel import CLEAR, ORBIT, control_id
from endoprior.view.saving import keep
from endoprior.view.server import MAX_KEPT, Viewer
from endoprior.view.viewable_scene import ViewableScene
from endoprior.view.viewport import bounded_aspect

pytestmark = pytest.mark.filterwarnings("ignore:Queued a:UserWarning")  # to a browser that has just left
KEY = base64.b64encode(b"0123456789abcdef").decode()
UPGRADE = (
    "GET {path} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: " + KEY + "\r\nSec-WebSocket-Protocol: " + VISER + "\r\n\r\n"
)


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    """A viewer of a small scene, at work during all of these tests."""
    out = tmp_path_factory.mktemp("run") / "view"
    with at_work(Viewer(ViewableScene(moving_scene(), "wall"), out=out)) as viewer:
        yield viewer


@pytest.fixture
def good(viewer):
    """A proper browser: it was there before, and is served afterwards."""
    client = Client(viewer.url)
    client.send_camera()
    client.image(quiet=0.1)
    yield client
    client.set(viewer.panel.frame, 1 + (viewer.settings.frame % 8))
    assert client.image(quiet=0.1).any()
    client.socket.close()
    late = Client(viewer.url)  # what is replayed to newcomers must have stayed whole, too
    late.send_camera()
    assert late.image(quiet=0.1).any()
    late.socket.close()


def raw(viewer, data: bytes, wait: float = 0.3) -> bytes:
    """What comes back over a plain socket for these bytes."""
    found = b""
    with socket.create_connection(("127.0.0.1", viewer.port)) as plain, suppress(OSError):
        plain.settimeout(wait)
        plain.sendall(data)
        while len(found) < 10_000 and (more := plain.recv(4096)):
            found += more
    return found


def frame(payload: bytes, opcode: int = 2, length: int | None = None, final: bool = True) -> bytes:
    """A masked frame of the WebSocket protocol that says it is `length` long."""
    length = len(payload) if length is None else length
    size = bytes([0x80 | length]) if length < 126 else bytes([0x80 | 127]) + struct.pack(">Q", length)
    return bytes([(0x80 if final else 0) | opcode]) + size + b"\0\0\0\0" + payload


def upgraded(viewer) -> bytes:
    """A request that the viewer answers with a WebSocket."""
    return UPGRADE.format(path=urlsplit(viewer.url).path).encode()


def resident_mb() -> float:
    """Memory of this process."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def test_malformed_requests(viewer, good):
    rng = np.random.default_rng(0)
    requests = [b"", b"\0" * 10_000, rng.bytes(5000), b"GET", b"GET / HTTP/1.1\r\nHost: x\r\n", b"\x16\x03\x01" * 50]
    requests += [b"GET / HTTP/1.1\r\n" + b"X: " + b"a" * 10**6, b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 100_000]
    requests.append(b"GET /" + b"a" * 10**6 + b" HTTP/1.1\r\n\r\n")
    requests.append(b"POST / HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n")
    for request in requests:
        assert b"Traceback" not in raw(viewer, request)


def test_no_path_leads_out_of_the_page(viewer, good):
    ups = ("../" * 12, "/", "..%2f" * 12, "%2e%2e/" * 12, "..%5c" * 12, "%252e%252e/" * 12, "%00/", "./.%2e/")
    for path in (f"{start}{up}etc/passwd" for up in ups for start in ("/", urlsplit(viewer.url).path)):
        answer = raw(viewer, f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        assert answer.startswith(b"HTTP/1.1 403"), path


def test_malformed_frames(viewer, good):
    before = resident_mb()
    bombs = [b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\x91" * 60_000]
    frames = [b"\xff" * 1000, frame(b"", length=2**63 - 1), frame(b"x", length=2**40)]
    frames += [frame(b"x" * (MAX_MESSAGE_BYTES + 1))]
    frames += [frame(b"x" * 60_000, final=False) + frame(b"x" * 60_000, 0, final=False) * 100]
    frames += [frame(b"text", 1), frame(b"ping" * 10, 9), frame(b"", 8), frame(b"\x03", 8), *map(frame, bombs)]
    for sent in frames:
        raw(viewer, upgraded(viewer) + sent)
    assert resident_mb() - before < 100


def messages(viewer) -> list[dict]:
    """Well-formed messages that no browser would send."""
    odd = ["x", None, [], {}, [1], True, 2**63, -(2**63), 1e308, np.nan, np.inf, -1, [np.nan] * 2, "x" * 10_000]
    odd.append([[]] * 50)
    ids = {name: control_id(handle) for name, handle in vars(viewer.panel).items() if hasattr(handle, "remove")}
    found = [{"type": kind} for kind in ("", "Message", "GuiUpdateMessage", "RunJavascriptMessage", "ShareUrlRequest")]
    for number, (name, uuid) in enumerate(ids.items()):
        pressed = [True] if hasattr(getattr(viewer.panel, name), "on_click") else []  # which is what a button is for
        found += [gui(uuid, value=value) for value in odd[number % 2 :: 2] if value not in pressed]
    for name in ("update_cb", "sync_cb", "removed", "is_button", "props", "gui_api", "uuid", "__class__", "no_such"):
        found += [gui(ids["frame"], **{name: value}) for value in ([], None, True, "x")]
    found += [gui("nobody", value=1), gui([1], value=1), gui(ids["frame"]) | {"updates": 3}]
    for name in ("wxyz", "position", "up_direction", "fov", "image_height", "image_width"):
        found += [camera_message(**{name: value}) for value in odd[len(name) % 2 :: 2]]
    found += [camera_message(wxyz=[0] * 4), camera_message(position=[1e308] * 3), camera_message(fov=0)]
    found += [camera_message(image_width=10**9, image_height=1), camera_message(image_width=0, image_height=0)]
    ray = {"ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1], "modifier": None}
    for place in ([], [[]], [[np.nan, 0]], [[1e308, 1e308]], [["x", "y"]], [[0.5, 0.5]] * 1000, 3, None):
        for kind in ("click", "rect-select", "no such", 3):
            found.append({"type": "ScenePointerMessage", "event_type": kind, "screen_pos": place, **ray})
    found.append(found[-1] | {"event_type": "click", "screen_pos": [[0.5, 0.5]], "ray_origin": None})
    found.append({"type": "ViewerCameraMessage"})
    for uuid in (ids["play"], "nobody"):
        start = {"source_component_uuid": uuid, "transfer_uuid": "t", "filename": "../../pwned", "mime_type": "x"}
        found.append({"type": "FileTransferStartUpload", **start, "part_count": 10**6, "size_bytes": 10**12})
        part = {"source_component_uuid": uuid, "transfer_uuid": "t", "content": b"x" * 50_000}
        found += [{"type": "FileTransferPart", **part, "part_index": i} for i in range(50)]
    return found


def gui(control, **updates) -> dict:
    """A change of a control."""
    return {"type": "GuiUpdateMessage", "uuid": control, "updates": updates}


class Stranger(Client):
    """A client that sends whatever it likes, and connects again when it is thrown out."""

    def __init__(self, url: str, **options) -> None:
        self.again = lambda: Client.__init__(self, url, close_timeout=0.01, **options)
        self.again()

    def say(self, message: dict) -> None:
        try:
            raw = msgspec.msgpack.encode(message)
        except OverflowError:  # msgpack has no such integer
            return
        try:
            self.socket.send(raw)
        except ConnectionClosed:
            self.again()
            self.send_camera()
            self.socket.send(raw)


@pytest.mark.slow
def test_messages_that_no_browser_sends(viewer, good, capfd):
    good.set(viewer.panel.camera, ORBIT)
    good.image(quiet=0.2)
    state = {name: handle.value for name, handle in vars(viewer.panel).items() if hasattr(handle, "value")}
    before, stranger = resident_mb(), Stranger(viewer.url, max_queue=None)
    stranger.send_camera()
    for message in messages(viewer):
        stranger.say(message)
    stranger.say(camera_message())
    time.sleep(0.5)
    stranger.socket.close()
    # True and 1 are values that some of them can have.
    switches = {"measure", "follow", "tool", "erase", "tracks", "correct", "smoke", "find"}
    allowed = switches | {"frame", "since", "clip"}
    now = {name: getattr(viewer.panel, name).value for name in state}
    assert {name for name in state if state[name] != now[name]} <= allowed
    assert now["clip"] == state["clip"] and 0 <= now["frame"] <= 9
    assert resident_mb() - before < 100
    for name in switches:
        good.set(getattr(viewer.panel, name), False)
    good.set(viewer.panel.camera, panels.ENDOSCOPE)
    good.image(quiet=0.2)
    assert "view/" not in capfd.readouterr().err  # messages of viser itself are allowed
    assert {path for path in viewer.out.parent.rglob("*") if viewer.out not in path.parents} <= {viewer.out}


def test_the_number_of_browsers_is_limited(viewer, good):
    crowd = []
    for _ in range(MAX_BROWSERS + 8):
        with suppress(InvalidStatus):
            crowd.append(Client(viewer.url, close_timeout=0.2))
    time.sleep(0.3)
    assert 0 < sum(client.connected for client in [good, *crowd]) <= MAX_BROWSERS
    for client in crowd:
        client.socket.close()
    end, free = time.monotonic() + 10, False
    while not free and time.monotonic() < end:  # until their places are free again
        with suppress(InvalidStatus):
            late = Client(viewer.url, close_timeout=0.2)
            late.send_camera()
            free = late.image(quiet=0.1).any()
            late.socket.close()
    assert free


@pytest.mark.slow
def test_a_flood_of_messages_is_limited(viewer, good):
    """Training calls `work` between two iterations: it must come back however much is asked for."""
    before, stop, ended = resident_mb(), threading.Event(), []

    def flood():
        stranger, k = Client(viewer.url, close_timeout=0.2), 0
        stranger.send_camera()
        with suppress(ConnectionClosed):
            while not stop.is_set():
                k += 1
                stranger.send_camera(position=[k % 7, 0, 0])
                stranger.set(viewer.panel.frame, k % 9)
                stranger.set(viewer.panel.points, CLEAR)
        ended.append(not stop.is_set())
        stranger.socket.close()

    threads = [threading.Thread(target=flood) for _ in range(2)]
    for thread in threads:
        thread.start()
    end = time.monotonic() + 20  # on a busy machine it takes a while to be too fast
    while len(ended) < 2 and time.monotonic() < end:
        with suppress(TimeoutError):
            good.read(0.1)
    stop.set()
    for thread in threads:
        thread.join()
    assert ended == [True, True] and resident_mb() - before < 150


def test_jobs_are_bounded_and_state_is_not_lost():
    jobs, done = JobQueue(), []
    for k in range(10 * MAX_WAITING):
        jobs.put(lambda k=k: done.append(k))
        jobs.put(lambda: done.append("state"), "key")
    jobs.put(lambda: done.append("sure"), surely=True)
    for job in jobs.take(0):
        job()
    assert len(done) <= MAX_WAITING + 2 and done.count("state") == 1 and done[-1] == "sure"
    jobs.put(lambda: None, "key")
    assert len(jobs.take(0)) == 1 and jobs.take(0) == []


@pytest.mark.slow
def test_saved_views_are_limited(viewer, good):
    for _ in range(MAX_KEPT + 5):
        good.set(viewer.panel.keep, True)
        time.sleep(0.002)
    end = time.monotonic() + 5
    while f"{MAX_KEPT} views" not in viewer.panel.status.content and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(0.2)
    assert f"{MAX_KEPT} saved views" in viewer.panel.status.content
    good.set(viewer.panel.forget, True)


def test_messages_are_validated():
    def sane(**changes):
        return is_valid_message(camera_message(**changes), lambda *_: True)

    assert sane() and sane(image_width=0) and not sane(fov=np.nan) and not sane(position=(np.inf, 0, 0))
    for kind in ("RemoveSceneNodeMessage", "FileTransferStartUpload", "FileTransferPart"):
        assert not is_valid_message({"type": kind}, lambda *_: True)
    for kind in ("GuiUpdateMessage", [], None):
        assert not is_valid_message({"type": kind}, lambda *_: True)
    assert not is_valid_message([], lambda *_: True)
    assert bounded_aspect(1e300, 1) == 4 and bounded_aspect(np.nan, 1) == bounded_aspect(0, 0) == 1


def test_names_of_folders_are_text(viewer):
    assert panels.plain("a_b/c![x](http://evil){alert(1)}<img src=x>") == (
        r"a\_b\/c\!\[x\]\(http\:\/\/evil\)\{alert\(1\)\}\<img src\=x\>"
    )
    assert "\n" not in panels.plain("a\nb") and panels.plain("größe 2") == "größe 2"


def test_a_link_in_an_untrusted_run_is_not_followed(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "view").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="got a link"):
        keep(tmp_path / "view", "color.png", b"x")
    assert not list((tmp_path / "elsewhere").iterdir())
