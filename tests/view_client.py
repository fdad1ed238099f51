"""A program that speaks viser's protocol in place of a browser, and a viewer at work in a thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

import cv2
import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray
from websockets.protocol import State
from websockets.sync.client import connect

from endoprior.view.incoming import BRUSH_NODE
from endoprior.view.panel import control_id

VISER = f"viser-v{version('viser')}"


def camera_message(**changes: Any) -> dict[str, Any]:
    """The message with the position of a browser's camera."""
    camera = {"wxyz": [1, 0, 0, 0], "position": [0, 0, 0], "look_at": [0, 0, 60], "up_direction": [0, -1, 0]}
    size = {"fov": 0.9, "near": 0.01, "far": 1000.0, "image_height": 480, "image_width": 600}
    return {"type": "ViewerCameraMessage", **camera, **size, **changes}


class Client:
    """The browser's side of one connection to the page at `url`: a canvas of 600 x 480 px."""

    def __init__(self, url: str, **options: Any) -> None:
        address = url.replace("http:", "ws:").removesuffix("/")
        self.socket = connect(address, subprotocols=[VISER], max_size=None, compression=None, **options)

    def send_camera(self, **changes: Any) -> None:
        """Send the position of its camera."""
        self.send(**camera_message(**changes))

    def send(self, type: str, **fields: Any) -> None:
        """Send one message."""
        self.socket.send(msgspec.msgpack.encode({"type": type, **fields}))

    def set(self, handle: Any, value: Any) -> None:
        """Change a control of the panel."""
        self.send("GuiUpdateMessage", uuid=control_id(handle), updates={"value": value})

    @property
    def connected(self) -> bool:
        """Whether the viewer has not thrown it out."""
        return self.socket.protocol.state is State.OPEN

    def click(self, x: float, y: float) -> None:
        """Click the canvas; (0, 0) is its upper left corner, (1, 1) its lower right."""
        ray = {"ray_origin": (0, 0, 0), "ray_direction": (0, 0, 1)}
        self.send("ScenePointerMessage", event_type="click", screen_pos=((x, y),), modifier=None, **ray)

    def drag(self, points: list[tuple[float, float]], modifier: str | None = None) -> None:
        """Drag the brush over the canvas, from point to point."""
        for k, point in enumerate([*points[1:], points[-1]]):
            phase = "start" if k == 0 else "end" if k == len(points) - 1 else "update"
            self.send(
                "SceneNodeDragMessage",
                phase=phase,
                name=BRUSH_NODE,
                instance_index=None,
                start_position=(0, 0, 5000),
                start_screen_pos=points[0],
                end_position=(0, 0, 5000),
                end_screen_pos=point,
                button="left",
                modifier=modifier,
                owner="",
            )

    def read(self, timeout: float) -> list[dict]:
        """The next messages; of an image the pixels, (H, W, 3) RGB, under `image`."""
        raw = self.socket.recv(timeout=timeout)
        length = int.from_bytes(raw[8:16], "little")
        messages = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + length]))["messages"]
        for message in messages:
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                message["image"] = _decoded(message["rgb_data"])
        return messages

    def image(self, timeout: float = 20, quiet: float = 0.8) -> NDArray[np.uint8]:
        """The last image, once nothing arrives for `quiet` seconds."""
        found, wait = None, timeout
        while True:
            try:
                for message in self.read(wait):
                    found = message.get("image", found)
            except TimeoutError:
                assert found is not None, "no image came"
                return found
            wait = timeout if found is None else quiet


def _decoded(data: bytes) -> NDArray[np.uint8]:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def wait_until(condition: Callable[[], object], seconds: float = 15) -> None:
    """Until it is true."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


@contextmanager
def at_work(viewer: Any) -> Iterator[Any]:
    """The viewer, working in a thread until the end."""
    stop = threading.Event()

    def work() -> None:
        while not stop.is_set():
            viewer.work(0.1)

    worker = threading.Thread(target=work)
    worker.start()
    try:
        yield viewer
    finally:
        stop.set()
        worker.join()
        viewer.close()
