"""A headless Chromium, driven over its debugging port."""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from PIL import Image
from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
START_SECONDS = 60.0
ANSWER_SECONDS = 180.0
"""Longest wait for an answer of the page; a frame is drawn by the processor, which may be busy."""


def find_browser() -> str | None:
    """Path of an installed Chromium, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page in a headless Chromium, a context manager.

    Args:
        url: what to open. size: of the window [px].
    """

    def __init__(self, url: str, size: tuple[int, int] = (960, 640)) -> None:
        program = find_browser()
        assert program is not None, "no Chromium is installed"
        self._folder = tempfile.TemporaryDirectory()
        words = (
            program,
            "--headless=new",
            "--no-sandbox",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--ignore-gpu-blocklist",
            "--hide-scrollbars",
            # It asks nobody for anything but the page.
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            f"--window-size={size[0]},{size[1]}",
            f"--user-data-dir={self._folder.name}",
            "--remote-debugging-port=0",
            url,
        )
        self._process = subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        # A browser that draws on a busy processor answers no pings for longer than they are waited for.
        self._socket = connect(
            self._page_address(), max_size=1 << 28, compression=None, ping_interval=None
        )
        self._count = 0
        self.console: list[str] = []
        self.call("Runtime.enable")
        self.call("Log.enable")

    def _page_address(self) -> str:
        port_file = Path(self._folder.name) / "DevToolsActivePort"
        wait_for(
            lambda: port_file.is_file() and port_file.read_text().strip(), START_SECONDS
        )
        port = port_file.read_text().splitlines()[0]

        def pages() -> list[dict[str, Any]]:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                return [page for page in json.load(answer) if page["type"] == "page"]

        return wait_for(pages, START_SECONDS)[0]["webSocketDebuggerUrl"]

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """The result of a command of the Chrome DevTools protocol."""
        self._count += 1
        number = self._count
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=ANSWER_SECONDS))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
            self.console.append(json.dumps(message["params"])[:2000])
        elif message.get("method") == "Runtime.consoleAPICalled":
            words = [
                str(arg.get("value", arg.get("description")))
                for arg in message["params"]["args"]
            ]
            self.console.append(" ".join(words))

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression."""
        found = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def resize(self, width: int, height: int) -> None:
        """Show the page as a screen of this size [px] does; up to 600 px as a phone."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width <= 600,
        )

    def open(self, url: str) -> None:
        """Go to another page and wait until it is loaded."""
        self.call("Page.navigate", url=url)
        wait_for(
            lambda: (
                self.run("location.href") == url
                and self.run("document.readyState") == "complete"
            ),
            START_SECONDS,
        )

    def press(self, code: str, key: str, *, down: bool) -> None:
        """Press or release a key, by its place and its meaning."""
        kind = "keyDown" if down else "keyUp"
        self.call("Input.dispatchKeyEvent", type=kind, code=code, key=key)

    def picture(self) -> np.ndarray:
        """What the page shows, (h, w, 3) uint8."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(timeout=10.0)
        assert self._process.stderr is not None
        self._process.stderr.close()
        time.sleep(0.2)
        shutil.rmtree(self._folder.name, ignore_errors=True)


def wait_for(ready: Callable[[], Any], seconds: float) -> Any:
    """What ``ready`` gives, once it is true; the last value and an error after so long [s]."""
    end = time.monotonic() + seconds
    while True:
        try:
            found = ready()
        except (OSError, AssertionError) as error:
            found = None
            problem: object = error
        else:
            problem = found
        if found:
            return found
        if time.monotonic() > end:
            raise AssertionError(f"not ready after {seconds:g} s: {problem}")
        time.sleep(0.1)
