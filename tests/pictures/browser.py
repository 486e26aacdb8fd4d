"""A real browser without a window, driven by its own protocol (DevTools)."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from types import TracebackType

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
PATIENCE_S = 60.0


class Browser:
    """One tab of a browser; `with Browser(folder) as browser` ends it."""

    def __init__(self, folder: Path) -> None:
        self._profile = folder / "profile"
        self._loop = asyncio.new_event_loop()
        self._number = 0
        self.requested: list[str] = []
        """Addresses that were asked for, other than the data of the page itself."""
        self.complaints: list[str] = []
        """What scripts threw."""

    def __enter__(self) -> Self:
        words = [str(BROWSER), *FLAGS, f"--user-data-dir={self._profile}", "--remote-debugging-port=0", "about:blank"]
        self._process = subprocess.Popen(words, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        port = wait_for(self._port)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            tab = next(one for one in json.load(answer) if one["type"] == "page")
        self._socket = self._loop.run_until_complete(_connected(tab["webSocketDebuggerUrl"]))
        for domain in ("Page", "Runtime", "Network", "DOM"):
            self.do(f"{domain}.enable")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._process.terminate()
        self._loop.run_until_complete(_closed(self._socket))
        self._loop.close()
        self._process.wait()

    def _port(self) -> str:
        known = self._profile / "DevToolsActivePort"
        return next(iter(known.read_text().splitlines()), "") if known.exists() else ""  # it is written in two steps

    async def _sent(self, message: dict[str, Any]) -> None:
        await self._socket.write_message(json.dumps(message))

    async def _received(self) -> str:
        message: str = await self._socket.read_message()
        return message

    def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        number = self._number
        self._loop.run_until_complete(self._sent({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._loop.run_until_complete(self._received()))
            if message.get("method") == "Network.requestWillBeSent":
                self.requested.append(message["params"]["request"]["url"])
            elif message.get("method") == "Runtime.exceptionThrown":
                self.complaints.append(str(message["params"]["exceptionDetails"]))
            elif message.get("id") == number:
                assert "error" not in message, message
                found: dict[str, Any] = message["result"]
                return found

    def size(self, width: int, height: int = 900, *, dark: bool = False) -> None:
        self.do(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.do("Emulation.setEmulatedMedia", features=scheme)

    def goto(self, address: str) -> None:
        self.do("Page.navigate", url=address)
        wait_for(lambda: self.tell("document.readyState === 'complete' && location.href !== 'about:blank'"))

    def tell(self, script: str) -> Any:
        found = self.do("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def key(self, key: str, *, text: str = "") -> None:
        codes = {"Tab": 9, "Enter": 13, " ": 32}
        known: dict[str, Any] = {"key": key, "windowsVirtualKeyCode": codes.get(key, 0)}
        self.do("Input.dispatchKeyEvent", type="keyDown", text=text, **known)
        self.do("Input.dispatchKeyEvent", type="keyUp", **known)

    def mouse(self, kind: str, x: float, y: float, buttons: int = 0) -> None:
        button = "left" if buttons or kind == "mouseReleased" else "none"
        self.do("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=buttons, clickCount=1)

    def touch(self, kind: str, *fingers: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
        self.do("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def choose(self, selector: str, files: list[Path]) -> None:
        root = self.do("DOM.getDocument")["root"]["nodeId"]
        node = self.do("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self.do("DOM.setFileInputFiles", nodeId=node, files=[str(path) for path in files])

    def shot(self, target: Path, *, whole: bool = True) -> None:
        found = self.do("Page.captureScreenshot", captureBeyondViewport=whole)
        target.write_bytes(base64.b64decode(found["data"]))


async def _connected(address: str) -> Any:
    from tornado.websocket import websocket_connect

    return await websocket_connect(address, max_message_size=200_000_000)


async def _closed(socket: Any) -> None:
    socket.close()
    while await socket.read_message() is not None:
        pass


def wait_for(known: Any) -> Any:
    """What a function gives as soon as it gives something."""
    deadline = time.monotonic() + PATIENCE_S
    while not (found := known()):
        assert time.monotonic() < deadline, "it did not come"
        time.sleep(0.02)
    return found
