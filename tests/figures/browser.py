"""Chromium without a window, driven over its debugging pipe (DevTools protocol, no further library)."""

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--headless=new", "--no-sandbox", "--remote-debugging-pipe", "--disable-dev-shm-usage",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-extensions",
)  # fmt: skip


def chromium() -> str | None:
    """Path of a Chromium on this machine, or None."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class Page:
    """One page of a Chromium of its own; a context manager.

    Attributes:
        trouble: errors and warnings on the console, and exceptions. requests: addresses asked for.
    """

    def __init__(self, address: str, *, width: int, height: int, dark: bool = False, seconds=120):
        self.trouble: list[str] = []
        self.requests: list[str] = []
        self._count, self._rest, self._limit = 0, b"", seconds
        self._replies: dict[int, Any] = {}
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        ours, theirs = os.pipe(), os.pipe()
        size = f"--window-size={width},{height}"
        command = [
            chromium() or "",
            *FLAGS,
            size,
            f"--user-data-dir={self._profile.name}",
            "about:blank",
        ]
        # the pipes become files 3 and 4, as Chromium wants them
        script = 'exec 3<"/dev/fd/$1" 4>"/dev/fd/$2"; shift 2; exec "$@"'
        self._process = subprocess.Popen(
            ["sh", "-c", script, "sh", str(ours[0]), str(theirs[1]), *command],
            pass_fds=(ours[0], theirs[1]), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(ours[0])
        os.close(theirs[1])
        self._write, self._read = ours[1], theirs[0]
        self._session = None
        target = self.ask("Target.createTarget", url="about:blank")
        attached = self.ask("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for name in ("Runtime", "Log", "Network", "Page"):
            self.ask(f"{name}.enable")
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[scheme])
        self.ask("Page.navigate", url=address)
        self.until("document.readyState === 'complete'")

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._write)
        os.close(self._read)
        self._profile.cleanup()

    def ask(self, method: str, **parameters: Any) -> Any:
        """Result of a method of the protocol."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + self._limit
        while self._count not in self._replies:
            self._take(until)
        reply = self._replies.pop(self._count)
        assert "error" not in reply, reply
        return reply["result"]

    def _take(self, until: float) -> None:
        ready, _, _ = select.select([self._read], [], [], max(0.0, until - time.monotonic()))
        got = os.read(self._read, 1 << 20) if ready else b""
        assert got, "Chromium does not answer"
        *whole, self._rest = (self._rest + got).split(b"\0")
        for text in whole:
            self._sort(json.loads(text))

    def _sort(self, message: dict[str, Any]) -> None:
        if "id" in message:
            self._replies[message["id"]] = message
            return
        method, about = message["method"], message["params"]
        if method == "Runtime.consoleAPICalled" and about["type"] in ("error", "warning", "assert"):
            self.trouble.append(str([each.get("value") for each in about["args"]]))
        elif method == "Runtime.exceptionThrown":
            self.trouble.append(json.dumps(about["exceptionDetails"]))
        elif method == "Log.entryAdded" and about["entry"]["level"] in ("error", "warning"):
            self.trouble.append(about["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(about["request"]["url"])

    def value(self, expression: str) -> Any:
        """Value of a JavaScript expression, as plain data."""
        found = self.ask(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, expression: str) -> None:
        """Wait until a JavaScript expression is true."""
        end = time.monotonic() + self._limit
        while not self.value(expression):
            assert time.monotonic() < end, f"not within {self._limit} s: {expression}"
            time.sleep(0.02)

    def picture(self, path: Path) -> None:
        """Save what the page shows as PNG."""
        path.write_bytes(base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"]))
