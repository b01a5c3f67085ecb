"""Drive a headless browser by clicks, drags and keys, and take screenshots."""

from __future__ import annotations

import base64
import contextlib
import json
import shutil
import signal
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser")
HOST = "127.0.0.1"
SIZE = 1280, 800  # pixels
START_S = 60.0
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # never through a proxy
_OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    # WebGL in software, which works on every machine.
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--remote-debugging-port=0", f"--window-size={SIZE[0]},{SIZE[1]}"),
    f"--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE {HOST}",  # no access to other machines
)


class Tab:
    """One page, controlled over the DevTools protocol.

    Args:
        address: address of the page's websocket.
        size: width and height of the page, pixels.
    """

    def __init__(self, address: str, size: tuple[int, int] = SIZE) -> None:
        self._socket: ClientConnection = connect(address, max_size=None, proxy=None)
        self._number = 0
        width, height = size
        self(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self("Page.enable")
        # So that the page renders also in the background.
        self("Emulation.setFocusEmulationEnabled", enabled=True)

    def __call__(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=START_S))
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def close(self) -> None:
        """Close the page."""
        self("Page.close")
        self._socket.close()

    def open(self, url: str, until: str) -> None:
        """Open a page and wait until its text contains ``until``."""
        self("Page.navigate", url=url)
        self.wait(f"document.body && document.body.innerText.includes({json.dumps(until)})")

    def script(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        answer = self("Runtime.evaluate", expression=expression, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(str(answer["exceptionDetails"]))
        return answer["result"].get("value")

    def wait(self, condition: str, seconds: float = START_S) -> None:
        """Wait until a JavaScript expression is true."""
        end = time.monotonic() + seconds
        while not self.script(f"!!({condition})"):
            if time.monotonic() > end:
                raise TimeoutError(f"the page did not satisfy: {condition}")
            time.sleep(0.1)

    def text(self) -> str:
        """Return the visible text of the page."""
        return str(self.script("document.body.innerText"))

    def click_button(self, label: str) -> None:
        """Click the button with a label, also if the page's layout is changing."""
        name = json.dumps(label)
        self.script(
            f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === {name})"
            ".click()"
        )

    def mouse(self, kind: str, x: float, y: float) -> None:
        """Press, move or release the left button at a point, in pixels."""
        held = 0 if kind == "mouseReleased" else 1
        button = "none" if kind == "hovered" else "left"
        if kind == "hovered":
            kind, held = "mouseMoved", 0
        self(
            "Input.dispatchMouseEvent",
            type=kind,
            x=x,
            y=y,
            button=button,
            buttons=held,
            clickCount=1 if kind != "mouseMoved" else 0,
        )

    def drag(self, start: tuple[float, float], end: tuple[float, float], moves: int = 10) -> None:
        """Drag from one point to another, in pixels."""
        self.mouse("hovered", *start)
        time.sleep(0.3)  # the page must render an object once while the mouse is over it
        self.mouse("mousePressed", *start)
        for i in range(1, moves + 1):
            share = i / moves
            x, y = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            self.mouse("mouseMoved", x, y)
        self.mouse("mouseReleased", *end)

    def key(self, key: str, code: str, number: int, modifiers: int = 0) -> None:
        """Press and release a key; modifiers: 2 for Ctrl, 8 for Shift."""
        common = {"key": key, "code": code, "windowsVirtualKeyCode": number}
        self("Input.dispatchKeyEvent", type="rawKeyDown", modifiers=modifiers, **common)
        self("Input.dispatchKeyEvent", type="keyUp", modifiers=modifiers, **common)

    def type_into(self, element: str, text: str) -> None:
        """Replace the text of an input, and press Enter."""
        self.script(f"(() => {{ const e = {element}; e.focus(); e.select(); }})()")
        self("Input.insertText", text=text)
        self.key("Enter", "Enter", 13)

    def picture(self) -> bytes:
        """Return a screenshot of the page, PNG."""
        return base64.b64decode(self("Page.captureScreenshot", format="png")["data"])


@contextlib.contextmanager
def browser() -> Iterator[Chromium]:
    """Run a browser inside the context."""
    assert PROGRAM is not None, "needs chromium"
    # The browser may write into its folder until its last child process has exited.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [PROGRAM, *_OPTIONS, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            yield Chromium(_port(Path(profile) / "DevToolsActivePort"))
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


class Chromium:
    """A running browser.

    Args:
        port: port of the DevTools protocol.
    """

    def __init__(self, port: int) -> None:
        self._port = port

    def tab(self, size: tuple[int, int] = SIZE) -> Tab:
        """Open a new page; a small one renders faster."""
        request = urllib.request.Request(
            f"http://{HOST}:{self._port}/json/new?about:blank", method="PUT"
        )
        with _DIRECT.open(request, timeout=START_S) as answer:
            return Tab(json.load(answer)["webSocketDebuggerUrl"], size)


def _port(file: Path) -> int:
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        with contextlib.suppress(OSError, IndexError, ValueError):
            return int(file.read_text().splitlines()[0])
        time.sleep(0.1)
    raise TimeoutError("the browser does not start")
