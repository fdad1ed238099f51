"""The viewer: from a moved slider to the picture that was sent, and what that is made of.

`python bench/viewer.py [--quick] [--json FILE] [--limit 100]`

A program that speaks viser's protocol stands in for the browser: it moves the slider and waits for the picture, so that
threads, drawing, JPEG and the socket all count. With --limit, the exit status is 1 if a row of 20,000 Gaussians at
640x512 takes longer, ms.
"""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass

import common
import cv2
import msgspec
import scenes
import zstandard
from websockets.sync.client import connect

import endoprior.view.server as server_module
from endoprior.model.presets import preset
from endoprior.view import browsers
from endoprior.view.panel import control_id
from endoprior.view.viewable import IDLE_SECONDS, ViewSettings
from endoprior.view.viewable_scene import ViewableScene

FRAMES = 24
LAYERS = ("color", "depth", "displacement")


@dataclass
class Client:
    """The browser's side of one connection."""

    url: str

    def __post_init__(self) -> None:
        version = server_module.viser.__version__
        address = self.url.replace("http:", "ws:").removesuffix("/")
        self.socket = connect(address, subprotocols=[f"viser-v{version}"], max_size=None, compression=None)
        camera = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "look_at": (0, 0, 60), "up_direction": (0, -1, 0)}
        camera |= {"fov": 0.9, "near": 0.01, "far": 1000.0, "image_height": 800, "image_width": 960}
        self.send("ViewerCameraMessage", **camera)

    def send(self, kind: str, **fields: object) -> None:
        """Send one message."""
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def wait_for(self, kind: str, timeout: float = 30) -> None:
        """Read until a message of this kind came."""
        while kind not in self.read(timeout):
            pass

    def read(self, timeout: float) -> list[str]:
        """Kinds of the next messages."""
        raw = self.socket.recv(timeout=timeout)
        length = int.from_bytes(raw[8:16], "little")
        content = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + length])
        return [message["type"] for message in msgspec.msgpack.decode(content)["messages"]]

    def drain(self, seconds: float) -> None:
        """Read until nothing came for a while."""
        try:
            while True:
                self.read(seconds)
        except TimeoutError:
            return


def measure(sizes: tuple[common.Size, ...]) -> list[common.Row]:
    """For each size and layer the time from slider to picture; drawing and JPEG alone."""
    measured = []
    for size in sizes:
        viewer = server_module.Viewer(make_viewable(size))
        worker = threading.Thread(target=work, args=(viewer, stop := threading.Event()), daemon=True)
        worker.start()
        client = Client(viewer.url)
        client.wait_for("BackgroundImageMessage")
        moves = iter(range(1, 1 << 30))

        def settle(_: object, client=client) -> None:
            client.drain(IDLE_SECONDS + 0.2)

        def move(_: object, client=client, viewer=viewer, moves=moves) -> None:
            slider = {"value": 1 + next(moves) * 7 % (FRAMES - 1)}
            client.send("GuiUpdateMessage", uuid=control_id(viewer.panel.frame), updates=slider)
            client.wait_for("BackgroundImageMessage")

        picture = (size.width, size.height)
        for layer in LAYERS:
            name = server_module.panel.LAYER_NAMES[layer]
            client.send("GuiUpdateMessage", uuid=control_id(viewer.panel.layer), updates={"value": name})
            steps = {"_settle": settle, "": move}
            measured += common.rows(f"viewer {layer}", common.race(steps), size.num, picture)
        stop.set()
        worker.join()
        viewer.close()
        measured += part_rows(viewer.viewable, size)
    return measured


def part_rows(viewable: ViewableScene, size: common.Size) -> list[common.Row]:
    """Drawing alone, and JPEG alone, at full size."""
    camera = viewable.cameras[0]
    pixels = cv2.cvtColor(viewable.picture(ViewSettings(frame=1), camera), cv2.COLOR_RGB2BGR)
    quality = [cv2.IMWRITE_JPEG_QUALITY, browsers.PREVIEW_QUALITY]
    steps = {
        "drawing alone": lambda _: viewable.picture(ViewSettings(frame=1), camera),
        "JPEG alone": lambda _: cv2.imencode(".jpg", pixels, quality),
    }
    return common.rows("viewer", common.race(steps), size.num, (size.width, size.height))


def work(viewer: server_module.Viewer, stop: threading.Event) -> None:
    """What `Viewer.run` does, until told to stop."""
    while not stop.is_set():
        viewer.work(0.2)


def make_viewable(size: common.Size) -> ViewableScene:
    """A scene of FRAMES frames."""
    splats, camera = scenes.splats(size)
    return ViewableScene(scenes.scene(splats, (camera,) * FRAMES, preset("default").fitted(68)), "bench")


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--limit", type=float, help="most milliseconds at 20,000 Gaussians and 640x512")
    options = parser.parse_args()
    common.set_threads(options.threads)
    measured = measure(common.sizes(options))
    common.report(measured, options)
    held = [row for row in measured if (row.gaussians, row.width) == (20_000, 640) and row.share is None]
    if options.limit and any(row.ours_ms > options.limit for row in held):
        sys.exit(1)
