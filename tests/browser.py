"""A headless Chromium for tests: one page, driven over Chromium's own pipe (DevTools protocol); no package needed.

with open_page(address) as page:
    page.wait_for("document.readyState == 'complete'")
    page.click("#play")
    assert not page.problems
"""

from __future__ import annotations

import base64
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
HOW_TO_INSTALL = (
    "SKIPPED, NOT TESTED: no Chromium found (looked for "
    + ", ".join(NAMES)
    + " and ENDOPRIOR_CHROMIUM). Install it: `apt-get update && apt-get install -y chromium`."
)
FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync "
    "--disable-dev-shm-usage --hide-scrollbars --mute-audio --force-device-scale-factor=1 "
    "--force-prefers-reduced-motion --remote-debugging-pipe"
).split()
# Chromium reads commands from descriptor 3 and answers on 4; Popen cannot number them.
LAUNCH = (
    "import fcntl, os, sys; ends = [fcntl.fcntl(int(fd), fcntl.F_DUPFD, 10) for fd in sys.argv[1:3]];"
    "os.dup2(ends[0], 3); os.dup2(ends[1], 4); os.execv(sys.argv[3], sys.argv[3:])"
)
HARMLESS = ("GPU stall due to ReadPixels",)  # Chromium's own remark when it renders without a graphics card
KEY_CODES = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "Home": 36, "End": 35, " ": 32}


def pictures_folder(name: str) -> Path:
    """Where images that tests make are kept to be looked at: below `build/`, or ENDOPRIOR_TEST_PICTURES."""
    folder = Path(os.environ.get("ENDOPRIOR_TEST_PICTURES", Path(__file__).parents[1] / "build")) / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def chromium_path() -> Path | None:
    """The browser: `ENDOPRIOR_CHROMIUM` or the first of the usual names on the path; None where there is none."""
    for name in (os.environ.get("ENDOPRIOR_CHROMIUM", ""), *NAMES):
        if name and (found := shutil.which(name)):
            return Path(found)
    return None


def require_chromium() -> Path:
    """The browser; where there is none the test is skipped, and the run's list of warnings says why and what to do."""
    found = chromium_path()
    if found is None:
        with warnings.catch_warnings():
            warnings.simplefilter("always")  # said even under `-W error`, and then not an error
            warnings.warn(HOW_TO_INSTALL, stacklevel=2)
        pytest.skip(HOW_TO_INSTALL)
    return found


class Page:
    """One tab. Positions are CSS px from the top left of the window."""

    def __init__(self, commands: int, answers: int) -> None:
        self.problems: list[str] = []
        """Errors and warnings of the console, exceptions nobody caught, things that did not load."""
        self.requests: list[str] = []
        """Addresses the page asked for, in order."""
        self._commands, self._answers = commands, answers
        self._replies: queue.Queue[dict] = queue.Queue()
        self._session: str | None = None
        self._count = 0
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def send(self, method: str, timeout: float = 60, **params: Any) -> dict:
        """Run one command of the DevTools protocol and return its result.

        Raises:
            RuntimeError: Chromium rejected it, ended, or gave no answer in `timeout` seconds.
        """
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + timeout
        while True:
            try:
                reply = self._replies.get(timeout=max(end - time.monotonic(), 0.01))
            except queue.Empty:
                raise RuntimeError(f"{method}: expected an answer within {timeout} s; got none") from None
            if reply.get("id") == self._count:
                break
            if "closed" in reply:
                raise RuntimeError(f"{method}: Chromium ended")
        if "error" in reply:
            raise RuntimeError(f"{method}: {reply['error']['message']}")
        return reply["result"]

    def attach(self, width: int, height: int) -> None:
        """Open the tab, `width` x `height` px, and listen to it."""
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        self.resize(width, height)

    def resize(self, width: int, height: int) -> None:
        """Change the size of the window's inside."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def go(self, address: str) -> None:
        """Load an address; returns once the page is complete. What its scripts do later is to be waited for."""
        failed = self.send("Page.navigate", url=address).get("errorText")
        if failed:
            raise RuntimeError(f"{address}: {failed}")
        self.wait_for("document.readyState == 'complete'", timeout=60)

    def evaluate(self, expression: str) -> Any:
        """Value of a JavaScript expression, as JSON; a promise is awaited.

        Raises:
            RuntimeError: it threw.
        """
        result = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            details = result["exceptionDetails"]
            raise RuntimeError(f"{expression}: {details.get('exception', {}).get('description', details['text'])}")
        return result["result"].get("value")

    def wait_for(self, expression: str, timeout: float = 30) -> Any:
        """Wait until an expression is true, and return its value.

        Raises:
            AssertionError: it is not after `timeout` seconds; says what went wrong on the page.
        """
        end = time.monotonic() + timeout
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < end, f"not true after {timeout} s: {expression}; problems: {self.problems}"
            time.sleep(0.02)
        return value

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width and height of the first element that matches, px."""
        found = self.evaluate(
            f"(e => {{ const b = e.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; }})"
            f"(document.querySelector({json.dumps(selector)}))"
        )
        return tuple(found)

    def click(self, selector: str) -> None:
        """Click the middle of the first element that matches."""
        left, top, width, height = self.box(selector)
        self.click_at(left + width / 2, top + height / 2)

    def click_at(self, x: float, y: float) -> None:
        """Click at a position."""
        self.drag([(x, y)])

    def drag(self, points: list[tuple[float, float]], button: str = "left") -> None:
        """Press a mouse button at the first point, move through the others, and let go."""
        self._mouse("mouseMoved", *points[0])
        self._mouse("mousePressed", *points[0], button=button, clickCount=1)
        held = {"left": 1, "right": 2, "middle": 4}[button]
        for point in points[1:]:
            self._mouse("mouseMoved", *point, button=button, buttons=held)
        self._mouse("mouseReleased", *points[-1], button=button, clickCount=1)

    def wheel(self, x: float, y: float, down: float) -> None:
        """Turn the wheel at a position, in px; positive scrolls down."""
        self._mouse("mouseWheel", x, y, deltaX=0, deltaY=down)

    def press(self, key: str) -> None:
        """Press and let go a key, named as in `KeyboardEvent.key`."""
        code = KEY_CODES.get(key, ord(key[0].upper()))
        text = {"text": key} if len(key) == 1 else {}
        name = "Space" if key == " " else key if len(key) > 1 else f"Key{key.upper()}"
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, code=name, windowsVirtualKeyCode=code, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key, code=name, windowsVirtualKeyCode=code)

    def screenshot(self, path: Path | None = None, selector: str | None = None) -> NDArray[np.uint8]:
        """(H, W, 3) RGB image of the window or of one element, written to `path` as PNG too."""
        clip = {}
        if selector:
            left, top, width, height = self.box(selector)
            clip = {"clip": {"x": left, "y": top, "width": width, "height": height, "scale": 1}}
        png = base64.b64decode(self.send("Page.captureScreenshot", format="png", **clip)["data"])
        if path:
            path.write_bytes(png)
        return np.ascontiguousarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])

    def _mouse(self, kind: str, x: float, y: float, **params: Any) -> None:
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **params)

    def _read(self) -> None:
        rest = b""
        with suppress(OSError):
            while piece := os.read(self._answers, 1 << 20):
                *messages, rest = (rest + piece).split(b"\0")
                for message in map(json.loads, messages):
                    self._replies.put(message) if "id" in message else self._note(message)
        self._replies.put({"closed": True})

    def _note(self, event: dict) -> None:
        name, params = event["method"], event.get("params", {})
        if name == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            said = (str(arg.get("value", arg.get("description"))) for arg in params["args"])
            self.problems.append(f"console.{params['type']}: {' '.join(said)}")
        elif name == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.problems.append(f"exception: {details.get('exception', {}).get('description', details['text'])}")
        elif name == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            text = params["entry"]["text"]
            if not any(part in text for part in HARMLESS):
                self.problems.append(f"log: {text} {params['entry'].get('url', '')}")
        elif name == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])


@contextmanager
def open_page(address: str, *, width: int = 1000, height: int = 800) -> Iterator[Page]:
    """Start Chromium with a new profile, show `address` in a window of that size, and end it afterwards.

    The test is skipped where there is no Chromium. `page.problems` is for the test to look at.
    """
    browser = require_chromium()
    profile = Path(tempfile.mkdtemp(prefix="endoprior-chromium-"))
    command_end, commands = os.pipe()
    answers, answer_end = os.pipe()
    arguments = [str(command_end), str(answer_end), str(browser), *FLAGS, f"--user-data-dir={profile}", "about:blank"]
    process = subprocess.Popen(
        [sys.executable, "-c", LAUNCH, *arguments],
        pass_fds=(command_end, answer_end),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    os.close(command_end)
    os.close(answer_end)
    page = Page(commands, answers)
    try:
        page.attach(width, height)
        page.go(address)
        yield page
    finally:
        os.close(commands)  # Chromium ends when nobody can command it any more
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            pass
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # its own session: the helpers that it started
        process.wait()
        page.reader.join(timeout=10)
        os.close(answers)
        shutil.rmtree(profile, ignore_errors=True)
