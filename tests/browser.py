"""A real browser without a window, by the WebDriver protocol over HTTP."""

import base64
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import Request, urlopen

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
MISSING = "" if CHROMIUM and DRIVER else "chromium and chromedriver are not installed"

ARGUMENTS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-dev-shm-usage", "--window-size=1280,800",
)  # fmt: skip


class Page:
    """A page in a session of the driver."""

    def __init__(self, driver: str) -> None:
        options = {"binary": CHROMIUM, "args": ARGUMENTS}
        wanted = {
            "browserName": "chrome",
            "goog:chromeOptions": options,
            "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
        }
        self.session, self.driver = "", driver
        made = self.ask("POST", "", {"capabilities": {"alwaysMatch": wanted}})
        self.session = f"/{made['sessionId']}"

    def ask(self, method: str, path: str, content: Any = None) -> Any:
        data = None if content is None else json.dumps(content).encode()
        request = Request(f"{self.driver}/session{self.session}{path}", data, method=method)
        with urlopen(request, timeout=60) as answer:
            return json.load(answer)["value"]

    def open(self, path: Path) -> None:
        self.ask("POST", "/url", {"url": path.as_uri()})

    def run(self, script: str, *given: Any) -> Any:
        return self.ask("POST", "/execute/sync", {"script": script, "args": list(given)})

    def picture(self) -> bytes:
        return base64.b64decode(self.ask("GET", "/screenshot"))

    def log(self, kind: str) -> list[dict[str, Any]]:
        return self.ask("POST", "/se/log", {"type": kind})

    def act(self, *actions: dict[str, Any]) -> None:
        """Moves and clicks of a mouse, or turns of its wheel."""
        kind = "wheel" if actions[0]["type"] == "scroll" else "pointer"
        device = {"type": kind, "id": kind, "actions": list(actions)}
        self.ask("POST", "/actions", {"actions": [device]})


@contextmanager
def browser() -> Iterator[Page]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [str(DRIVER), f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        for _ in range(100):
            try:
                urlopen(f"http://127.0.0.1:{port}/status", timeout=5).close()
                break
            except (URLError, OSError):
                time.sleep(0.1)
        page = Page(f"http://127.0.0.1:{port}")
        try:
            yield page
        finally:
            page.ask("DELETE", "")
    finally:
        process.terminate()
        process.wait(10)
