"""A page in headless Chromium, driven over a pipe by its DevTools protocol; tests skip where there is none."""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--no-first-run",
    "--hide-scrollbars", "--force-prefers-reduced-motion", "--disable-background-networking",
)  # fmt: skip
PATIENCE_S = 30.0


class Page:
    """What the page asked for (`requests`) and complained of (`errors`), and hands for it."""

    def __init__(self, read: int, write: int) -> None:
        self._read, self._write, self._left, self._number, self._session = read, write, b"", 0, ""
        self.requests: list[str] = []
        self.errors: list[str] = []

    def open(self, address: str, width: int = 1000, height: int = 700, dark: bool = False) -> None:
        """Shows an address in a new window of this size, when it is loaded."""
        self._session = ""
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for part in ("Page", "Runtime", "Network", "Log"):
            self.send(f"{part}.enable")
        self.look(width, height, dark)
        self.requests, self.errors = [], []
        self.send("Page.navigate", url=address)
        self.until("document.readyState === 'complete' && location.href !== 'about:blank'")

    def look(self, width: int, height: int, dark: bool = False, media: str = "") -> None:
        """The window's size, its colours, and whether it is a screen's or, as `print`, paper's."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.send("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", media=media, features=[scheme])

    def send(self, method: str, **params: Any) -> Any:
        """A command of the protocol, and its answer."""
        self._number += 1
        reported = {"id": self._number, "method": method, "params": params}
        if self._session:
            reported["sessionId"] = self._session
        os.write(self._write, json.dumps(reported).encode() + b"\0")
        while True:
            message = self._message()
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]

    def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        found = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, script: str) -> None:
        """Waits for an expression to be true."""
        end = time.monotonic() + PATIENCE_S
        while not self.run(script):
            assert time.monotonic() < end, f"never: {script}"
            time.sleep(0.05)

    def click(self, selector: str, part: float = 0.5) -> None:
        """The mouse on an element, at this part of its width."""
        box = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
        left, top, width, height = self.run(f"(b => [b.left, b.top, b.width, b.height])({box})")
        at = {"x": left + part * width, "y": top + height / 2.0, "button": "left", "clickCount": 1}
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, **at)

    def drag(self, *places: tuple[float, float]) -> None:
        """The mouse pressed at the first place, moved through the others, let go at the last."""
        kinds = ["mousePressed", *["mouseMoved"] * (len(places) - 1), "mouseReleased"]
        for kind, (x, y) in zip(kinds, (*places, places[-1]), strict=True):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def _message(self) -> dict[str, Any]:
        while b"\0" not in self._left:
            ready, _, _ = select.select([self._read], [], [], PATIENCE_S)
            assert ready, "Chromium says nothing"
            self._left += os.read(self._read, 1 << 20)
        text, _, self._left = self._left.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        reported = message.get("params", {})
        match message.get("method"):
            case "Network.requestWillBeSent":
                self.requests.append(reported["request"]["url"])
            case "Log.entryAdded" if reported["entry"]["level"] in ("error", "warning"):
                self.errors.append(f"{reported['entry']['text']} {reported['entry'].get('url', '')}")
            case "Runtime.consoleAPICalled" if reported["type"] in ("error", "warning", "assert"):
                self.errors.append(str(reported["args"]))
            case "Runtime.exceptionThrown":
                self.errors.append(str(reported["exceptionDetails"]))
        return message


@contextmanager
def browser(profile: Path) -> Iterator[Page]:
    """Chromium. profile: a folder for what it writes."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("there is no Chromium here")
    asked, reported = os.pipe(), os.pipe()
    # it reads from the third file and writes to the fourth
    shell = f'exec "$0" "$@" 3<&{asked[0]} 4>&{reported[1]}'
    process = subprocess.Popen(
        ["bash", "-c", shell, program, *OPTIONS, f"--user-data-dir={profile}"], pass_fds=(asked[0], reported[1]),
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(asked[0])
    os.close(reported[1])
    try:
        yield Page(reported[0], asked[1])
    finally:
        process.kill()
        process.wait()
        os.close(reported[0])
        os.close(asked[1])
